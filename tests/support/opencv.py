"""OpenCV, the oracle of lenses; it counts pixels from the centre of the first one. Tests skip where it is missing."""

import numpy as np
import pytest

from phd_exp.optics.lens import Lens

HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
UNTIL = (3, 500, 1e-13)  # steps and change at which its iterations end


def projected(xyz: np.ndarray, K: np.ndarray, lens: Lens) -> np.ndarray:
    """Pixels (n, 2) of positions (n, 3)."""
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    project = cv2.fisheye.projectPoints if lens.is_fisheye else cv2.projectPoints
    zero = np.zeros(3)
    return project(xyz[:, None], zero, zero, K - HALF, np.array(lens.coefficients))[0].reshape(-1, 2) + 0.5


def undistorted(pixel: np.ndarray, K: np.ndarray, lens: Lens) -> np.ndarray:
    """(x, y)/z (n, 2) of pixels (n, 2)."""
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    given = (pixel[:, None] - 0.5, K - HALF, np.array(lens.coefficients))
    if lens.is_fisheye:
        return cv2.fisheye.undistortPoints(*given, criteria=UNTIL).reshape(-1, 2)
    if int(cv2.__version__.split(".")[0]) < 5:
        return cv2.undistortPointsIter(*given, None, None, UNTIL).reshape(-1, 2)
    return cv2.undistortPoints(*given, criteria=UNTIL).reshape(-1, 2)
