"""Virtual cameras: square cameras that face a box in the image of a real camera.

The principal point of a crop may lie anywhere. A turn of the camera about its centre towards the box moves it to the
middle. A turn changes any image by a homography, so that the labels of the turned camera are exact.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Box = tuple[float, float, float, float]
"""Left, top, right, bottom: pixels of the real image, counted from its top left corner."""


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A real camera turned about its centre, with a square image and the principal point in its middle.

    Args:
        K: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the real camera, pixels; it has no distortion.
        R: rotation from the frame of the real camera to that of the virtual one.
        f: focal length of the virtual camera, pixels.
        S: side of the virtual image, pixels.

    Source: own derivation; both cameras are pinholes with one centre.

    Examples:
        >>> K = intrinsics(900.0, 900.0, 320.0, 240.0)
        >>> camera = VirtualCamera.of_box(K, (270.0, 190.0, 370.0, 290.0), S=200.0)
        >>> camera.f, camera.to_virtual(np.array([0.0, 0.0, 4.0]))
        (1800.0, array([0., 0., 4.]))
    """

    K: Float[np.ndarray, "3 3"]
    R: Float[np.ndarray, "3 3"]
    f: float
    S: float

    @classmethod
    def of_box(cls, K: Float[np.ndarray, "3 3"], box: Box, S: float) -> "VirtualCamera":
        """The virtual camera that faces the middle of a box and whose image just contains its four corners.

        R is the smallest rotation that maps the ray through the middle of the box to the optical axis, and
        f = S / (2 max(|x|, |y|) / z) over the corners (x, y, z) of the box in the virtual frame.

        Raises:
            ValueError: the box is so wide that a part of the virtual image is 90 degrees or more from the optical
                axis of either camera, where there is no pinhole image.
        """
        left, top, right, bottom = box
        middle = rays(K, np.array([(left + right) / 2, (top + bottom) / 2]))
        R = smallest_rotation(middle / np.linalg.norm(middle))
        corners = rays(K, np.array([[left, top], [right, top], [left, bottom], [right, bottom]])) @ R.T
        if not (corners[:, 2] > 0).all():
            raise ValueError("its corners are 90 degrees or more from its middle; no pinhole image shows that")
        half_width = np.abs(corners[:, :2] / corners[:, 2:]).max()
        seen = np.array([[x, y, 1.0] for x in (-half_width, half_width) for y in (-half_width, half_width)])
        if not (seen @ R[:, 2] > 0).all():  # z in the frame of the real camera, from R^T
            raise ValueError("a square view of it reaches 90 degrees or more from the axis of its camera")
        return cls(K, R, f=float(S / (2 * half_width)), S=float(S))

    def to_virtual(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Positions (metres) of the frame of the real camera in that of the virtual one: R xyz."""
        return xyz @ self.R.T

    def to_real(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Positions (metres) of the frame of the virtual camera in that of the real one: R^T xyz."""
        return xyz @ self.R

    @property
    def homography(self) -> Float[np.ndarray, "3 3"]:
        """H = K_v R K^-1, from homogeneous pixels of the real image to those of the virtual one."""
        return intrinsics(self.f, self.f, self.S / 2, self.S / 2) @ self.R @ np.linalg.inv(self.K)

    @property
    def densities(self) -> tuple[float, float]:
        """The fewest and the most pixels of the real image along one pixel of the virtual image.

        These are the extreme singular values of the Jacobian of the map H^-1: (u, v) -> (p, q) = (X, Y)/W, over
        the middle and the corners of the virtual image.
        """
        back = np.linalg.inv(self.homography)
        places = [(0.5, 0.5), (0, 0), (0, 1), (1, 0), (1, 1)]
        densities = []
        for u, v in places:
            X = back @ np.array([u * self.S, v * self.S, 1.0])
            jacobian = (back[:2, :2] - np.outer(X[:2] / X[2], back[2, :2])) / X[2]
            densities.extend(np.linalg.svd(jacobian, compute_uv=False).tolist())
        return min(densities), max(densities)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: positions to homogeneous pixels; all in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rays(K: Float[np.ndarray, "3 3"], pixel: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    """Position at depth one that projects to a pixel: ((u - cx)/fx, (v - cy)/fy, 1)."""
    xy = (pixel - K[:2, 2]) / np.diagonal(K)[:2]
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)


def smallest_rotation(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation about an axis in the image plane (no roll) that maps a unit vector (z > 0) to (0, 0, 1).

    For (a, b, c) it is [[1 - a^2/(1+c), -ab/(1+c), -a], [-ab/(1+c), 1 - b^2/(1+c), -b], [a, b, c]].

    Source: Rodrigues' formula for the axis (b, -a, 0).
    """
    a, b, c = direction
    first, second = [1 - a * a / (1 + c), -a * b / (1 + c), -a], [-a * b / (1 + c), 1 - b * b / (1 + c), -b]
    return np.array([first, second, [a, b, c]])
