"""Virtual cameras: square cameras that face a box in the image of a real camera.

The principal point of a crop may lie anywhere. A turn of the camera about its centre towards the box moves it to the
middle. A turn changes any image by a homography, so that the labels of the turned camera are exact. It is a
pinhole whatever the lens of the real camera.
"""

from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
from jaxtyping import Bool, Float

from phd_exp.optics.lens import PINHOLE, Lens

BORDER = 33  # places along a side of a box whose rays a lens bends

Box = tuple[float, float, float, float]
"""Left, top, right, bottom: pixels of the real image, counted from its top left corner."""


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A real camera turned about its centre, with a square pinhole image and the principal point in its middle.

    Args:
        K: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the real camera, pixels.
        R: rotation from the frame of the real camera to that of the virtual one.
        f: focal length of the virtual camera, pixels.
        S: side of the virtual image, pixels.
        lens: of the real camera.

    Source: own derivation; both cameras have one centre.

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
    lens: Lens = PINHOLE

    @classmethod
    def of_box(
        cls, K: Float[np.ndarray, "3 3"], box: Box, S: float, lens: Lens = PINHOLE, largest_f: float = np.inf
    ) -> "VirtualCamera":
        """The virtual camera that faces the middle of a box and whose image just contains its border.

        R is the smallest rotation that maps the ray through the middle of the box to the optical axis, and
        f = S / (2 max(|x|, |y|) / z) over the border (x, y, z) of the box in the virtual frame; its corners decide,
        unless a lens bends the border. If f exceeds `largest_f`, the image is as wide as that permits.

        Raises:
            ValueError: the middle of the box has no ray; or the box is so wide that a part of the virtual image is 90
                degrees or more from its optical axis, or, except for a fisheye, from that of the real camera.
        """
        left, top, right, bottom = box
        centre = np.array([[(left + right) / 2, (top + bottom) / 2]])
        places = np.concatenate([centre, _border(box, 2 if lens.is_pinhole else BORDER)])
        directions = rays(K, places, lens)
        middle, border = directions[0], directions[1:]
        border = border[np.isfinite(border).all(axis=-1)]
        if not (np.isfinite(middle).all() and len(border)):
            raise ValueError(f"box={list(box)}: its middle or its whole border lies beyond the field of the lens")
        R = towards(middle)
        border = product(border, R.T)
        if not (border[:, 2] > 0).all():
            raise ValueError(f"box={list(box)}: its corners are 90 degrees or more from its middle")
        half_width = max(np.abs(border[:, :2] / border[:, 2:]).max(), S / (2 * largest_f))
        seen = np.array([[x, y, 1.0] for x in (-half_width, half_width) for y in (-half_width, half_width)])
        if not (lens.is_fisheye or (product(seen, R[:, 2]) > 0).all()):  # z in the frame of the real camera, from R^T
            raise ValueError(
                f"box={list(box)}: a square view of it reaches 90 degrees or more from the camera's axis"
            )
        return cls(K, R, f=float(S / (2 * half_width)), S=float(S), lens=lens)

    def to_virtual(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Positions (metres) of the frame of the real camera in that of the virtual one: R xyz."""
        return product(xyz, self.R.T)

    def to_real(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Positions (metres) of the frame of the virtual camera in that of the real one: R^T xyz."""
        return product(xyz, self.R)

    def real_pixels(self, xy_over_z: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels of the real image at (x, y)/z of the virtual camera; NaN where the real camera sees nothing."""
        xyz = np.concatenate([xy_over_z, np.ones_like(xy_over_z[..., :1])], axis=-1)
        place = self.lens.distort(self.to_real(xyz))
        # axis by axis: numpy takes ten times as long for rows of two
        return np.stack([self.K[axis, 2] + self.K[axis, axis] * place[..., axis] for axis in (0, 1)], axis=-1)

    def grid(self, along: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n 2"]:
        """Pixels of the real image at places along both sides of the virtual image, from -1 to 1."""
        return self.real_pixels(self.S / self.f / 2 * np.stack(np.meshgrid(along, along), axis=-1))

    def outside(self, width: float, height: float) -> Bool[np.ndarray, "S S"]:
        """The pixels of the virtual image whose middles lie outside the real image of that size, px."""
        half, size = self.S / self.f / 2, np.array([width, height])
        around = self.real_pixels(_border((-half, -half, half, half), BORDER))
        if ((around >= 0) & (around <= size)).all():
            return np.zeros((int(self.S), int(self.S)), bool)
        along = (np.arange(int(self.S)) + 0.5 - self.S / 2) / self.f
        place = self.real_pixels(np.stack(np.meshgrid(along, along), axis=-1))
        return ~((place >= 0) & (place <= size)).all(axis=-1)

    @property
    def homography(self) -> Float[np.ndarray, "3 3"]:
        """H = K_v R K^-1, from homogeneous pixels of a real image without distortion to those of the virtual one."""
        (fx, fy), (cx, cy) = np.diagonal(self.K)[:2], self.K[:2, 2]
        inverse = intrinsics(1 / fx, 1 / fy, -cx / fx, -cy / fy)
        return product(product(intrinsics(self.f, self.f, self.S / 2, self.S / 2), self.R), inverse)


def product(a: Float[np.ndarray, "*batch n"], b: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "..."]:
    """a @ b for a vector or matrix b, with the same bits on every processor and for any number of rows.

    The sums of BLAS depend on both. Whatever a data set records is computed by this function.
    """
    terms = (np.multiply.outer(row, column) for row, column in zip(b, np.moveaxis(a, -1, 0), strict=True))
    return np.moveaxis(reduce(np.add, terms), range(b.ndim - 1), range(1 - b.ndim, 0))


def unit(vector: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The unit vector of the same direction."""
    return vector / np.sqrt(product(vector, vector))


def enlarged(box: Box, factor: float) -> Box:
    """The box with the same middle and sides `factor` times as long."""
    left, top, right, bottom = box
    across, down = (factor - 1) * (right - left) / 2, (factor - 1) * (bottom - top) / 2
    return left - across, top - down, right + across, bottom + down


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: positions to homogeneous pixels; all in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def towards(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation without roll that maps a direction to (0, 0, 1), as `geometry.motion.smallest_rotation`."""
    a, b, c = unit(direction)
    ab = a * b / (1 + c)
    return np.array([[1 - a * a / (1 + c), -ab, -a], [-ab, 1 - b * b / (1 + c), -b], [a, b, c]])


def rays(
    K: Float[np.ndarray, "3 3"], pixel: Float[np.ndarray, "*batch 2"], lens: Lens = PINHOLE
) -> Float[np.ndarray, "*batch 3"]:
    """Position that projects to a pixel: `Lens.undistort` of ((u - cx)/fx, (v - cy)/fy)."""
    return lens.undistort((pixel - K[:2, 2]) / np.diagonal(K)[:2])


def require_no_fold(K: Float[np.ndarray, "3 3"], lens: Lens, width: int, height: int) -> None:
    """Raise ValueError if, on the way from its middle to a corner of an image, a lens folds over.

    A circular fisheye, whose 180 degrees end inside the image, does not.
    """
    if lens.limit < np.pi and (fold := _fold(tuple(map(tuple, K.tolist())), lens, width, height)):
        raise ValueError(fold)


@lru_cache(maxsize=64)  # a folder of images has one camera, or a few
def _fold(rows: tuple[tuple[float, ...], ...], lens: Lens, width: int, height: int) -> str | None:
    """Where a lens folds over inside an image; None if it does not."""
    K = np.array(rows)
    corners = _border((0.0, 0.0, float(width), float(height)), 2)
    if not np.isnan(rays(K, corners, lens)).any():
        return None
    way = (K[:2, 2] + np.linspace(0, 1, 1001)[:, None, None] * (corners - K[:2, 2])).reshape(-1, 2)
    x, y, z = rays(K, way, lens).T
    angle = np.arctan2(np.hypot(x, y), z)
    pixel = way[np.nanargmax(angle)].round(1).tolist()
    fold = np.nanmax(angle) if lens.limit == np.pi / 2 else lens.limit  # the former of tangential terms alone
    return (
        f"the lens folds over inside the image of {width} x {height} pixels, {np.degrees(fold):.1f} degrees from "
        f"its axis, at pixel {pixel}; check its coefficients"
    )


def _border(box: Box, n: int) -> Float[np.ndarray, "places 2"]:
    """Places along the four sides of a box, n a side, from corner to corner."""
    left, top, right, bottom = box
    x, y = np.linspace(left, right, n), np.linspace(top, bottom, n)
    u = np.concatenate([x, x, np.full(n, left), np.full(n, right)])
    return np.stack([u, np.concatenate([np.full(n, top), np.full(n, bottom), y, y])], axis=-1)
