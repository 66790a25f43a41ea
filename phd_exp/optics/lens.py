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
from numpy.polynomial import Polynomial

ANGLES = 2000  # of the table from which Newton's method starts
STEPS = 12  # of Newton's method, whose convergence is quadratic
CLOSE = 1e-10  # largest error of `undistort`, in focal lengths
TINY = 1e-30  # length that replaces zero in a quotient, and the step of the complex-step derivative


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

    def distort(self, xyz: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """The place ((u - cx)/fx, (v - cy)/fy) of directions; NaN from the `limit` on."""
        if self.is_pinhole:
            ahead = xyz[..., 2:] > 0
            return np.where(ahead, xyz[..., :2] / np.where(ahead, xyz[..., 2:], 1), np.nan)
        across = np.linalg.norm(xyz[..., :2], axis=-1, keepdims=True)
        angle = np.arctan2(across, xyz[..., 2:])
        bare = (angle if self.is_fisheye else np.tan(angle)) * (xyz[..., :2] / np.maximum(across, TINY))
        return np.where(angle < self.limit, self._moved(bare), np.nan)

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
        s = angle if self.is_fisheye else np.tan(angle)
        bare = np.stack([s, 0 * s], axis=-1)
        distance = (self._moved(bare) - self._moved(-bare))[:, 0] / 2  # without the tangential terms, which are even
        falls = np.flatnonzero(~(np.diff(distance) > 0))
        n = falls[0] + 1 if len(falls) else ANGLES
        return float(angle[n - 1]) if len(falls) else widest, s[:n], distance[:n]

    @np.errstate(all="ignore")  # powers overflow near 90 degrees
    def _moved(self, bare: Inexact[np.ndarray, "*batch 2"]) -> Inexact[np.ndarray, "*batch 2"]:
        r2, k = (bare * bare).sum(axis=-1, keepdims=True), (*self.coefficients, *[0.0] * 8)
        if self.is_fisheye:
            return bare * Polynomial((1.0, *k[:4]))(r2)
        p, ratio = np.array([k[3], k[2]]), Polynomial((1.0, k[0], k[1], k[4]))(r2) / Polynomial((1.0, *k[5:8]))(r2)
        return bare * (ratio + 2 * (bare @ p)[..., None]) + r2 * p

    def _unmoved(self, place: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        _, s, distance = self._radial
        far = np.linalg.norm(place, axis=-1, keepdims=True)
        bare = place * (np.interp(far, distance, s) / np.maximum(far, TINY))
        for _ in range(STEPS):
            (a, c), (b, d) = (np.moveaxis(self._moved(bare + 1j * TINY * e).imag / TINY, -1, 0) for e in np.eye(2))
            x, y = np.moveaxis(self._moved(bare) - place, -1, 0)
            bare = bare - np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]
        error = np.linalg.norm(self._moved(bare) - place, axis=-1, keepdims=True)
        found = (error <= CLOSE * (1 + far)) & (np.linalg.norm(bare, axis=-1, keepdims=True) <= s[-1])
        return np.where(found, bare, np.nan)


PINHOLE = Lens()
