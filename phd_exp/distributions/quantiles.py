"""Quantile regression: predicted quantiles of v_p and log z, and the density that interpolates them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.distributions import spd
from phd_exp.distributions.density import nodes
from phd_exp.distributions.shaped import Shaped

LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
"""Probabilities of the predicted quantiles."""


class Quantiles(Shaped):
    """Independent v_p and log z, each an increasing function of a standard normal variable.

    The functions are linear between the quantiles and beyond them. The quantiles are what training fits; the density
    only interpolates them. Regions are balls of the three normal variables.

    Args:
        law: has the medians, B = I and a = 1, so that (q, s) are v_p and log z about their medians.
        further: raw numbers of the gaps between the quantiles of each variable.

    Source: own derivation; quantile regression is Koenker and Bassett's (1978).
    """

    exponent = 0

    @property
    def knots(self) -> Float[Tensor, "*batch 3 quantiles"]:
        """The quantiles of v_p and log z, from their medians."""
        gaps = spd.positive(self.further).unflatten(-1, (3, -1)) * self._normal_knots.diff()
        knots = pad(gaps.cumsum(-1), (1, 0))
        return knots - knots[..., [len(LEVELS) // 2]]

    @property
    def _normal_knots(self) -> Tensor:
        return torch.special.ndtri(torch.tensor(LEVELS).to(self.further))

    def about_medians(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """v_p and log z of a position (metres), from their medians."""
        q, s, _, _ = self._whitened(xyz)
        return torch.cat([q, s[..., None]], dim=-1)

    def _normal(self, q: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return _interpolated(torch.cat([q, s[..., None]], dim=-1), self.knots, self._normal_knots)

    def _log_law(self, q: Tensor, s: Tensor) -> Tensor:
        u, log_slope = self._normal(q, s)
        return super()._log_law(u[..., :2], u[..., 2]) + log_slope.sum(-1)

    def _level(self, q: Tensor, s: Tensor) -> Tensor:
        u, _ = self._normal(q, s)
        return super()._level(u[..., :2], u[..., 2])

    def _cdf(self, s: Tensor) -> Tensor:
        return super()._cdf(_interpolated(s, self.knots[..., 2, :], self._normal_knots)[0])

    def _icdf(self, p: Tensor) -> Tensor:
        return _interpolated(super()._icdf(p), self._normal_knots, self.knots[..., 2, :])[0]

    def _draw(self, shape: Sequence[int], generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        normal, s = super()._draw(shape, generator)
        return _interpolated(normal, self._normal_knots, self.knots[..., :2, :])[0], s

    @property
    def _ray(self) -> tuple[Tensor, Tensor]:
        """Mean and variance of q."""
        p, weight = nodes(self.law.mu_xy)
        q = _interpolated(super()._icdf(p), self._normal_knots, self.knots[..., :2, :])[0]
        mean = (weight * q).sum(0)
        return mean, (weight * (q - mean).square()).sum(0)

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        return self.law.mu_xy + spd.matvec(self._spread[0], self._ray[0])

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        return spd.square(self._spread[0]) * self._ray[1][..., None]


def _interpolated(x: Tensor, xs: Tensor, ys: Tensor) -> tuple[Tensor, Tensor]:
    """The increasing piecewise linear function through the knots, and the log of its slope."""
    shape = torch.broadcast_shapes(x.shape, xs.shape[:-1], ys.shape[:-1])
    x, xs, ys = x.expand(shape)[..., None], xs.expand(*shape, -1), ys.expand(*shape, -1)
    left = (x >= xs[..., 1:-1]).sum(-1, keepdim=True)
    slope = ys.diff().gather(-1, left) / xs.diff().gather(-1, left)
    return (ys.gather(-1, left) + slope * (x - xs.gather(-1, left))).squeeze(-1), slope.log().squeeze(-1)
