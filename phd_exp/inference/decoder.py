"""From the numbers of an exported network to positions and their uncertainty, with NumPy and SciPy alone.

One file to copy: it imports nothing else of this project. The formulas are those of `ProjectedHuber`: with
q = A ((x, y)/z - mu_xy) z/mu_z and t = z/mu_z independent,

    -log p = h(|q|) - log|A/mu_z| + log(2 pi (1 + e^(-1/2))) + a max(t, 1/t) + log(mu_z N(a))        for z > 0.

Positions are in metres in the frame of the camera: x right, y down, z forward along its axis.

Source: paper, section "Projected Huber distribution"; parity with torch: tests/inference/test_decoder.py.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import expn

METADATA = "phd_exp"
"""The key of an ONNX file's metadata that holds what `Decoder.of` reads."""
Array = np.ndarray

_Z = 1 + math.exp(-0.5)
_LOG_K = math.log(2 * math.pi * _Z)
_C = (2 + 13 * math.exp(-0.5)) / (2 * _Z)  # Cov[q] = _C I
_LARGE = 20.0  # beyond this a, quadrature; up to it, exponential integrals
_NODES, _WEIGHTS = np.polynomial.laguerre.laggauss(48)
_TINY = 1e-300


@dataclass(frozen=True)
class Decoder:
    """What a network's numbers mean.

    Args:
        side: of the network's square image, pixels.
        head: "ProjectedHuber", or the chart of a baseline: "Projected", "LogDepth" or "Cartesian".
        mu_z0: depth per focal length, metres per pixel.
        D: the data set's depth range, a factor either way.
        z_centre: middle of the range of depth, metres.
        xy_unit: of a Cartesian chart, metres.
        constant_f: the focal length that the network was told for every image; None: the true one.
        temperature: (projected, depth), by which A and a are divided; (1, 1) as trained.
    """

    side: int
    head: str
    mu_z0: float
    D: float
    z_centre: float
    xy_unit: float
    constant_f: float | None
    temperature: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> "Decoder":
        """From the metadata of an exported file: `session.get_modelmeta().custom_metadata_map`."""
        values = json.loads(metadata[METADATA])["decoder"]
        return cls(**values | {"temperature": tuple(values["temperature"])})

    def __call__(self, raw: Any, f: Any) -> "Position | Array":
        """Positions with their uncertainty; of a baseline the bare positions, (..., 3).

        Args:
            raw: the network's numbers, (..., 7) or (..., 3).
            f: focal length in pixels of the network's image: of an image W pixels wide, f of it times side / W.
        """
        raw = np.asarray(raw, dtype=float)
        f = np.broadcast_to(
            np.asarray(f if self.constant_f is None else self.constant_f, float), raw.shape[:-1]
        )
        if not (f > 0).all():
            raise ValueError(f"f must be positive, but is {f}")
        return self._position(raw, f) if self.head == "ProjectedHuber" else self._point(raw, f)

    def _point(self, raw: Array, f: Array) -> Array:
        if self.head == "Cartesian":
            return np.concatenate([raw[..., :2] * self.xy_unit, raw[..., 2:] + self.z_centre], axis=-1)
        z_p = np.exp(self.D * raw[..., 2]) if self.head == "LogDepth" else raw[..., 2] + 1
        z = z_p * self.mu_z0 * f
        return z[..., None] * _direction(raw[..., :2] * self.side / (2 * f[..., None]))

    def _position(self, raw: Array, f: Array) -> "Position":
        projected, depth = self.temperature
        log_a = _log_positive(raw[..., 5])
        w = raw[..., 6]
        log_nu_z = np.sign(w) * np.logaddexp(0, np.log(np.maximum(np.abs(w), _TINY)) - log_a)
        B, log_det_B = _spectral_map(raw[..., 2:5])
        scale = 2 / (self.side * self.mu_z0)
        return Position(
            A_xy=scale / projected * B,
            nu_xy=raw[..., :2] / (projected * self.mu_z0 * f[..., None]),
            log_det_A_xy=log_det_B + 2 * math.log(scale / projected),
            log_mu_z=log_nu_z + np.log(self.mu_z0 * f),
            log_a=log_a - math.log(depth),
        )


@dataclass(frozen=True)
class Position:
    """The Projected Huber distribution of a batch of positions: q = A_xy (x, y) - nu_xy z, A_xy = A/mu_z."""

    A_xy: Array
    nu_xy: Array
    log_det_A_xy: Array
    log_mu_z: Array
    log_a: Array

    @cached_property
    def mu_xy(self) -> Array:
        """Centre of (x, y)/z."""
        centre: Array = _inverse(self.A_xy, self.log_det_A_xy) @ self.nu_xy[..., None]
        return centre[..., 0]

    @cached_property
    def mode(self) -> Array:
        """The position of highest density, mu_z (mu_xy, 1), metres."""
        return np.exp(self.log_mu_z)[..., None] * _direction(self.mu_xy)

    @cached_property
    def _depth_moments(self) -> tuple[Array, Array]:
        """E[t] and Var[t], from the moments of the excess energy so that nothing cancels."""
        a = np.exp(self.log_a)
        j = [_tail(k, a) for k in range(3)]
        first, second = (1 - j[1]) / (1 + j[0]), (2 + j[2]) / (1 + j[0])
        return 1 + first / a, (second - first**2) / a**2

    @property
    def mean(self) -> Array:
        """E[z] (mu_xy, 1), metres."""
        return self._depth_moments[0][..., None] * self.mode

    @property
    def covariance(self) -> Array:
        """Var[z] m m^T + c A_xy^(-2) with m = (mu_xy, 1), square metres."""
        along = self._depth_moments[1][..., None, None] * self.mode[..., :, None] * self.mode[..., None, :]
        inverse = _inverse(self.A_xy, self.log_det_A_xy)
        along[..., :2, :2] += _C * inverse @ inverse
        return along

    @property
    def median_depth(self) -> Array:
        """The depth with as much probability before as behind it, metres."""
        return self.depth_quantile(0.5)

    def depth_quantile(self, p: Any) -> Array:
        """The depth z (metres) with P(depth <= z) = p in (0, 1); a list of p adds a last dimension."""
        log_a, log_mu_z = self.log_a, self.log_mu_z
        if np.ndim(p):
            log_a, log_mu_z = log_a[..., None], log_mu_z[..., None]
        return np.exp(log_mu_z + _log_quantile(np.asarray(p, dtype=float), log_a))

    def log_prob(self, xyz: Any) -> Array:
        """Log density of positions (metres), nats per cubic metre; -inf behind the camera."""
        xyz = np.asarray(xyz, dtype=float)
        log_peak = (
            self.log_det_A_xy - _LOG_K - self.log_mu_z - np.log1p(_tail(0, np.exp(self.log_a))) + self.log_a
        )
        return np.where(xyz[..., 2] > 0, log_peak - self._energy(xyz), -np.inf)

    def level(self, xyz: Any) -> Array:
        """Credible level of positions: the probability of the smallest region of highest density that holds each."""
        xyz = np.asarray(xyz, dtype=float)
        return np.where(xyz[..., 2] > 0, _credible_level(self._energy(xyz), np.exp(self.log_a)), 1.0)

    def _energy(self, xyz: Array) -> Array:
        """Log density at the mode minus that at a position."""
        z = np.where(xyz[..., 2] > 0, xyz[..., 2], 1)
        q = (self.A_xy @ xyz[..., :2, None])[..., 0] - self.nu_xy * z[..., None]
        r = np.linalg.norm(q, axis=-1)
        return np.where(r <= 1, r**2 / 2, r - 0.5) + _excess(np.abs(np.log(z) - self.log_mu_z), self.log_a)


def _direction(mu_xy: Array) -> Array:
    return np.concatenate([mu_xy, np.ones_like(mu_xy[..., :1])], axis=-1)


def _log_positive(s: Array) -> Array:
    """log of s + 1 for s >= 0, of e^s for s < 0."""
    return np.log1p(np.maximum(s, 0)) + np.minimum(s, 0)


def _spectral_map(b: Array) -> tuple[Array, Array]:
    """[[b_1, b_2/sqrt 2], [b_2/sqrt 2, b_3]] with exp(`_log_positive`) of its eigenvalues, and log|.|."""
    middle, half, off = (b[..., 0] + b[..., 2]) / 2, (b[..., 0] - b[..., 2]) / 2, b[..., 1] / math.sqrt(2)
    r = np.hypot(half, off)
    log_upper, log_lower = _log_positive(middle + r), _log_positive(middle - r)
    mean = (np.exp(log_upper) + np.exp(log_lower)) / 2
    slope = (np.exp(log_upper) - np.exp(log_lower)) / np.where(r > 0, 2 * r, 1)
    rows = [[mean + slope * half, slope * off], [slope * off, mean - slope * half]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1)), log_upper + log_lower


def _inverse(M: Array, log_det: Array) -> Array:
    adjugate = np.stack([M[..., 1, 1], -M[..., 0, 1], -M[..., 1, 0], M[..., 0, 0]], axis=-1)
    root = np.exp(-log_det / 2)[..., None, None]
    return adjugate.reshape(M.shape) * root * root


def _scaled_expint(n: int, a: Array) -> Array:
    """e^a E_n(a) = int_0^inf e^(-s) (1 + s/a)^(-n) ds / a."""
    return np.where(a > _LARGE, _by_rule(0, n, a) / np.maximum(a, _LARGE), _by_expn(n, a))


def _by_expn(n: int, a: Array) -> Array:
    small = np.clip(a, _TINY, _LARGE)
    return np.exp(small) * expn(n, small)


def _by_rule(k: int, n: int, a: Array) -> Array:
    """int_0^inf s^k e^(-s) (1 + s/a)^(-n) ds for large a."""
    large = np.maximum(a, _LARGE)[..., None]
    return (_WEIGHTS * _NODES**k * (1 + _NODES / large) ** -float(n)).sum(-1)


def _tail(k: int, a: Array) -> Array:
    """J_k(a) = int_0^inf s^k e^(-s) (1 + s/a)^(-k-2) ds."""
    a = np.asarray(a, dtype=float)
    small = np.minimum(a, _LARGE)
    terms = [(-1) ** j * math.comb(k, j) * _by_expn(2 + j, small) for j in range(k + 1)]
    return np.where(a > _LARGE, _by_rule(k, k + 2, a), small ** (k + 1) * sum(terms))


def _excess(distance: Array, log_a: Array) -> Array:
    """a (e^distance - 1)."""
    return np.exp(np.minimum(log_a + distance, 700)) * -np.expm1(-distance)


def _log_quantile(p: Array, log_a: Array) -> Array:
    """The log t with P(t) = p: in closed form beyond the mode, before it by Newton's method on a convex function."""
    p, log_a = np.broadcast_arrays(p, log_a)
    a = np.exp(log_a)
    g = _tail(0, a)
    below = p * (1 + g) < g
    w = -np.log1p(-np.where(below, 0.5, p)) - np.log1p(g)
    upper = np.logaddexp(0, np.log(np.where(below, 1, np.maximum(w, _TINY))) - log_a)
    log_e_2 = np.log(_scaled_expint(2, a))
    drop = np.where(below, log_a + log_e_2 - np.log1p(g) - np.log(p), 1)
    distance = np.minimum(drop, np.logaddexp(0, np.log(drop) - log_a))
    for _ in range(8):
        e_2 = _scaled_expint(2, np.exp(log_a + distance))
        value = _excess(distance, log_a) + distance - np.log(e_2) + log_e_2 - drop
        distance = np.maximum(distance - value * e_2, 0)
    return np.where(below, -distance, upper)


def _credible_level(energy: Array, a: Array) -> Array:
    """P(h(|q|) + a (max(t, 1/t) - 1) <= energy)."""
    a = np.maximum(a, 1e-150)
    W = np.minimum(energy, 1400)
    X = np.maximum(W - 0.5, 0)
    tail_W, tail_X = _lower_tail(W, a), _lower_tail(X, a)
    linear = X * (W + 1.5) - X**2 / 2 + (W + 1.5) * X * (a / (a + X)) - a**2 * _log_remainder(X / a)
    flat = (W - X) * (1 + a / (a + W) * a / (a + X))
    rest = math.exp(-0.5) * (np.exp(-X) + tail_X - np.exp(-W) - tail_W)
    outside = np.exp(-W) + tail_W + (np.exp(-W) * (linear + flat) + rest) / _Z
    return np.clip(1 - outside / (1 + _tail(0, a)), 0, 1)


def _lower_tail(w: Array, a: Array) -> Array:
    return np.exp(-w) * (a / (a + w)) ** 2 * _tail(0, a + w)


def _log_remainder(y: Array) -> Array:
    """log(1 + y) - y/(1 + y), about y^2/2 where y is small."""
    u = np.where(y < 0.5, y / (2 + y), 0)
    series = np.zeros_like(u)
    for k in reversed(range(1, 12)):
        series = (series + 1 / (2 * k + 1)) * u**2
    return np.where(y < 0.5, 2 * u * (series + u / (1 + u)), np.log1p(y) - y / (1 + y))
