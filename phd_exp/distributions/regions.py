"""The smallest region of a credible level: h(|q|) + e(t) <= W with the excess energy e of depth, which is convex.

The depth t runs over [1/T, T] with e(T) = W. Given t, q runs over a disc of radius r(W - e(t)), where r is the
inverse of h.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy import integrate
from scipy.spatial import ConvexHull

from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

PRECISIONS = torch.logspace(-4, 5, 91, dtype=torch.float64)
OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])
_BENDS = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 401))  # depths, denser where the region closes


@dataclass(frozen=True, eq=False)
class Region:
    """The positions of credible level at most `level` < 1 in a distribution, or in each of a batch."""

    distribution: ProjectedHuber
    level: float | Float[np.ndarray, "*batch"]

    def depth_interval(
        self, axis: Float[np.ndarray, "*batch 3"] = OPTICAL_AXIS
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """The extent along a unit vector c, metres; [mu_z/T, mu_z T] along the optical axis.

        At the depth t it is c . apex + mu_z (t c . m +- |A^(-1) (c_x, c_y)| r) with m = (m_xy, 1). Source: own
        derivation; checked against samples.
        """
        p, (log_t, r) = self.distribution, self._discs
        A, m_xy, apex, mu_z = (one.double().numpy() for one in (p.A, p.m_xy, p.apex, p.mu_z))
        across = np.linalg.norm(np.linalg.solve(A, axis[..., :2, None])[..., 0], axis=-1)
        middle = np.exp(log_t) * ((axis[..., :2] * m_xy).sum(-1) + axis[..., 2])[..., None]
        start, reach = (axis * apex).sum(-1), across[..., None] * r
        low, high = (middle - reach).min(-1), (middle + reach).max(-1)
        return np.asarray(start + mu_z * low), np.asarray(start + mu_z * high)

    @property
    def volume(self) -> Float[np.ndarray, "*batch"]:
        """The volume, pi mu_z^3/|A| int_(1/T)^T r^2 dt, cubic metres. Source: own derivation; checked by samples."""
        log_t, r = self._discs
        discs = math.pi * integrate.simpson(r**2 * np.exp(log_t), x=log_t)
        return np.asarray(discs * (3 * self.distribution.mu_z.log() - self.distribution.log_det_A).exp().numpy())

    def outlines(self) -> list[Float[np.ndarray, "_ 2"]]:
        """The closed outlines of one region on the image, of (x, y)/z, and from above, of (x, z) in metres."""
        border = self.rings(101, 72).reshape(-1, 3)
        views = border[:, :2] / border[:, 2:], border[:, ::2]
        hulls = [ConvexHull(view, qhull_options="QbB").vertices for view in views]
        return [view[[*hull, hull[0]]] for view, hull in zip(views, hulls, strict=True)]

    def rings(self, depths: int, angles: int) -> Float[np.ndarray, "{depths} {angles} 3"]:
        """Positions around the border of one region, metres, at increasing depths; at the first and the last depth,
        all are the same. `depths` is a divisor of 400 plus one.
        """
        p, every, angle = self.distribution, 400 // (depths - 1), 2 * np.pi / angles * np.arange(angles)
        log_t, r = (one[::every, None, None] for one in self._discs)
        q = r * np.stack([np.cos(angle), np.sin(angle)], -1)
        t = np.broadcast_to(np.exp(log_t), (depths, angles, 1))
        xy = t * p.m_xy.double().numpy() + q @ np.linalg.inv(p.A.double().numpy())
        return np.asarray(p.apex.double().numpy() + float(p.mu_z) * np.concatenate([xy, t], -1))

    @cached_property
    def _discs(self) -> tuple[Float[np.ndarray, "*batch depths"], Float[np.ndarray, "*batch depths"]]:
        """log t and the radius of the disc of q at several depths."""
        log_a, rounding = self.distribution.a.double().log()[..., None], self.distribution.rounding
        law = depth_law(log_a, rounding)
        level, W = np.asarray(self.level)[..., None], np.empty(log_a.shape)
        for one in np.unique(level):
            energies = np.interp(log_a, PRECISIONS.log(), level_energies(float(one), rounding))
            W = np.where(level == one, energies, W)
        log_t = law.farthest_log_t(torch.from_numpy(W)) * torch.from_numpy(_BENDS)
        left = np.maximum(W - law.energy(log_t).numpy(), 0)
        return log_t.numpy(), np.where(left < 0.5, np.sqrt(2 * left), left + 0.5)


@cache
def level_energies(level: float, rounding: float) -> Float[np.ndarray, " precisions"]:
    """The W of the region with the probability `level` < 1 at each a of `PRECISIONS`, by bisection.

    W depends so little on a that linear interpolation over log a errs by less than 1e-4 in level.
    """
    law = depth_law(PRECISIONS.log(), rounding)
    low, high = torch.zeros_like(PRECISIONS), torch.full_like(PRECISIONS, 64)
    for _ in range(60):
        middle = (low + high) / 2
        inside = law.level(middle) < level
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return high.numpy()
