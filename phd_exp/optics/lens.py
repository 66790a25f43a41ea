"""Lenses: a direction to its place in the image, and back.

A pinhole shows a direction at the bare place b = (x, y)/z; for a fisheye, b is the angle to the axis times the unit
vector along (x, y). With r^2 = |b|^2 and p = (p2, p1), a lens moves b to

    b (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + r^2 p + 2 (p.b) b,

and a fisheye moves b to b (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Inexact
from numpy.polynomial.polynomial import polyval

ANGLES = 2000  # of the table from which Newton's method starts
STEPS = 12  # of Newton's method at most, whose convergence is quadratic
LAST_STEP = 1e-12  # focal lengths; a step below it is the last
CLOSE = 1e-10  # largest error of `undistort`, in focal lengths
TINY = 1e-30  # length that replaces zero in a quotient, and the step of the complex-step derivative

_Numbers = Inexact[np.ndarray, "*batch"]
_arctan2 = np.frompyfunc(math.atan2, 2, 1)  # numpy's own has other last bits on processors with AVX-512


@dataclass(frozen=True)
class Lens:
    """OpenCV's radial-tangential or rational lens, or a Kannala-Brandt fisheye; without coefficients, a pinhole.

    Args:
        coefficients: k1, k2, p1, p2, k3 to k6, or the first of them; k1 to k4 of a fisheye.
        is_fisheye: whether it may show directions 90 degrees and more from its axis.

    Source: the documentation of OpenCV's `calib3d` and `fisheye`.

    Examples:
        >>> lens = Lens((-0.2, 0.05, 0.001, 0.0))
        >>> place = lens.distort(np.array([0.5, 0.25, 1.0]))
        >>> place.round(4), lens.undistort(place).round(12)
        (array([0.4714, 0.236 ]), array([0.5 , 0.25, 1.  ]))
    """

    coefficients: tuple[float, ...] = ()
    is_fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether it moves nothing."""
        return not (self.is_fisheye or any(self.coefficients))

    @property
    def limit(self) -> float:
        """The angle to the axis, radians, at which it folds over: 90 degrees, for a fisheye 180, if it never does."""
        return self._radial[0]

    @np.errstate(all="ignore")  # powers overflow near 90 degrees
    def distort(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """The place ((u - cx)/fx, (v - cy)/fy) of directions; NaN from the `limit` on."""
        # axis by axis: numpy takes ten times as long for rows of two
        x, y, z = (xyz[..., axis] for axis in range(3))
        if self.is_fisheye:
            across = np.hypot(x, y)
            angle = np.asarray(_arctan2(across, z), float)
            scale = np.where(angle < self.limit, angle, np.nan) / np.maximum(across, TINY)
            moved = self._moved(x * scale, y * scale)
        else:
            is_shown = (z > 0) & (x * x + y * y < (z * math.tan(self.limit)) ** 2)
            z = np.where(is_shown, z, np.nan)
            moved = self._moved(x / z, y / z)
        return np.stack(moved, axis=-1)

    @np.errstate(all="ignore")
    def undistort(self, place: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
        """A direction whose place is given, by Newton's method; NaN if there is none.

        Its z is one; for a fisheye, its length is.
        """
        bare = place if self.is_pinhole else self._unmoved(place)
        s = np.linalg.norm(bare, axis=-1, keepdims=True)
        if self.is_fisheye:
            return np.concatenate([bare * np.sinc(s / np.pi), np.cos(s)], axis=-1)
        return np.concatenate([bare, 1 + 0 * s], axis=-1)

    @cached_property
    def _radial(self) -> tuple[float, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """The `limit`; and from the axis to there |b|, and the distance of its place, which grows."""
        widest = math.pi if self.is_fisheye else math.pi / 2
        angle = np.linspace(0, widest, ANGLES, endpoint=False)
        s = angle if self.is_fisheye else np.sin(angle) / np.cos(angle)
        # without the tangential terms, which are even
        distance = (self._moved(s, 0 * s)[0] - self._moved(-s, 0 * s)[0]) / 2
        falls = np.flatnonzero(~(np.diff(distance) > 0))
        n = falls[0] + 1 if len(falls) else ANGLES
        return float(angle[n - 1]) if len(falls) else widest, s[:n], distance[:n]

    @np.errstate(all="ignore")  # powers overflow near 90 degrees
    def _moved(self, x: _Numbers, y: _Numbers) -> tuple[_Numbers, _Numbers]:
        """The place of a bare place (x, y), and of several."""
        if self.is_pinhole:
            return x, y
        r2, k = x * x + y * y, (*self.coefficients, *[0.0] * 8)
        if self.is_fisheye:
            scale = polyval(r2, (1.0, *k[:4]))
            return x * scale, y * scale
        ratio = polyval(r2, (1.0, k[0], k[1], k[4])) / polyval(r2, (1.0, *k[5:8]))
        scale = ratio + 2 * (k[3] * x + k[2] * y)
        return x * scale + r2 * k[3], y * scale + r2 * k[2]

    def _unmoved(self, place: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        _, s, distance = self._radial
        u, v = place[..., 0], place[..., 1]
        far = np.hypot(u, v)
        x, y = (one * (np.interp(far, distance, s) / np.maximum(far, TINY)) for one in (u, v))
        steps = 1j * TINY * np.eye(2).reshape(2, 2, *[1] * x.ndim)
        for _ in range(STEPS):
            moved_u, moved_v = self._moved(x + steps[0], y + steps[1])
            (a, b), (c, d) = moved_u.imag / TINY, moved_v.imag / TINY  # the derivatives by x and by y
            off_u, off_v, area = moved_u[0].real - u, moved_v[0].real - v, a * d - b * c
            by_x, by_y = (d * off_u - b * off_v) / area, (a * off_v - c * off_u) / area
            x, y = x - by_x, y - by_y
            if not (np.hypot(by_x, by_y) > LAST_STEP).any():  # NaN where there is no direction
                break
        moved_x, moved_y = self._moved(x, y)
        error = np.hypot(moved_x - u, moved_y - v)
        found = (error <= CLOSE * (1 + far)) & (np.hypot(x, y) <= s[-1])
        return np.where(found[..., None], np.stack([x, y], axis=-1), np.nan)


PINHOLE = Lens()
