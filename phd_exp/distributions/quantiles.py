"""Quantile regression: predicted quantiles of v_p and log z, and the density that interpolates them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.distributions import spd
from phd_exp.distributions.density import Density, nodes
from phd_exp.distributions.laws import NormalLaw
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.shaped import Whitening
from phd_exp.distributions.special import signed_log1p

LEVELS = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
"""Probabilities of the predicted quantiles."""
_LAW, _MIDDLE = NormalLaw(), len(LEVELS) // 2


@final
@dataclass(frozen=True)
class Quantiles(Density):
    """Independent v_p and log z, each an increasing function of a standard normal variable.

    The functions are linear between the quantiles and beyond them. The quantiles are what training fits; the density
    only interpolates them. Regions are balls of the three normal variables.

    Args:
        medians: the map to v_p, from its median, and to log z_p.
        knots: the quantiles of these.

    Source: own derivation; quantile regression is Koenker and Bassett's (1978).
    """

    has_closed_forms: ClassVar[Literal[False]] = False
    medians: Whitening
    knots: Float[Tensor, "*batch 3 quantiles"]

    @classmethod
    def from_raw(cls, medians: ProjectedHuber, raw: Float[Tensor, "*batch n"]) -> "Quantiles":
        """From a density with the median of v_p, B = I, a = 1 and nu_z = 1, and raw numbers of depth and all gaps.

        The first gives the median of log z_p, the log nu_z of w_2 for a = 1. It is one of the knots, so that v_p,
        from its median, does not depend on it.
        """
        depth, gaps = raw[..., :1], raw[..., 1:]
        size = spd.positive(gaps).unflatten(-1, (3, -1)) * _normal_knots(gaps).diff()
        knots = pad(size.cumsum(-1), (1, 0))
        log_z_p = pad(signed_log1p(depth, torch.zeros_like(depth)), (2, 0))[..., None]
        return cls(Whitening(medians, 0), knots - knots[..., [_MIDDLE]] + log_z_p)

    def variables(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
        """v_p of a position (metres), from its median, and log z_p."""
        q, s, _, _ = self.medians.variables(xyz)
        return torch.cat([q, s[..., None]], dim=-1)

    def _normal(self, xyz: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Two and one normal variables of a position, and the log of their slope; volume and visibility."""
        q, s, volume, visible = self.medians.variables(xyz)
        u, log_slope = _interpolated(torch.cat([q, s[..., None]], dim=-1), self.knots, _normal_knots(self.knots))
        return u[..., :2], u[..., 2], log_slope.sum(-1), volume, visible

    def _quantiles(self, u: Tensor, variables: slice | int) -> Tensor:
        """The values of some variables, given their normal ones."""
        return _interpolated(u, _normal_knots(self.knots), self.knots[..., variables, :])[0]

    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        *u, log_slope, volume, visible = self._normal(value)
        return (_LAW.log_prob(*u) + log_slope + volume).masked_fill(~visible, -torch.inf)

    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """The probability of the ball of normal variables that contains a position."""
        *u, _, _, visible = self._normal(xyz)
        return _LAW.level(*u).masked_fill(~visible, 1)

    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        a = self.medians.around.a
        q, s = _LAW.draw((*sample_shape, *a.shape), a, generator)
        return self.medians.position(self._quantiles(q, slice(2)), self._quantiles(s, 2))

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        return self.medians.position(torch.zeros_like(self.medians.around.mu_xy), self.knots[..., 2, _MIDDLE])

    @property
    def _ray(self) -> tuple[Tensor, Tensor]:
        """Mean and variance of v_p, from its median."""
        p, weight = nodes(self.medians.around.mu_xy)
        q = self._quantiles(_LAW.icdf(p), slice(2))
        mean = (weight * q).sum(0)
        return mean, (weight * (q - mean).square()).sum(0)

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        return self.medians.around.mu_xy + spd.matvec(self.medians.A_inverse, self._ray[0])

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        return spd.square(self.medians.A_inverse) * self._ray[1][..., None]

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        s, visible = self.medians.s(z)
        u, _ = _interpolated(s, self.knots[..., 2, :], _normal_knots(self.knots))
        return _LAW.cdf(u).masked_fill(~visible, 0)

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        return self.medians.z(self._quantiles(_LAW.icdf(torch.as_tensor(p).to(self.knots)), 2))


def _normal_knots(like: Tensor) -> Tensor:
    return torch.special.ndtri(torch.tensor(LEVELS).to(like))


def _interpolated(x: Tensor, xs: Tensor, ys: Tensor) -> tuple[Tensor, Tensor]:
    """The increasing piecewise linear function through the knots, and the log of its slope."""
    shape = torch.broadcast_shapes(x.shape, xs.shape[:-1], ys.shape[:-1])
    x, xs, ys = x.expand(shape)[..., None], xs.expand(*shape, -1), ys.expand(*shape, -1)
    left = (x >= xs[..., 1:-1]).sum(-1, keepdim=True)
    slope = ys.diff().gather(-1, left) / xs.diff().gather(-1, left)
    return (ys.gather(-1, left) + slope * (x - xs.gather(-1, left))).squeeze(-1), slope.log().squeeze(-1)
