"""A mixture of Gaussians in space, the usual density of a mixture density network."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Normal
from torch.nn.functional import pad
from torch.quasirandom import SobolEngine

from phd_exp.distributions.density import Density, quantile_between
from phd_exp.distributions.laws import NormalLaw
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.shaped import Shaped, Whitening

_NORMAL = Normal(0.0, 1.0, validate_args=False)
_DRAWS, _AT_ONCE = 512, 128  # draws of each Gaussian for a level, and those in memory at a time
_STEPS = 30  # of the fixed point to the mode


@final
@dataclass(frozen=True, eq=False)
class GaussianMixture(Density):
    """Gaussians in space with weights.

    Args:
        parts: the Gaussians; their last batch dimension counts them.
        log_weight: unnormalised logs of the weights.

    Source: Bishop, "Mixture density networks" (1994).
    """

    has_closed_forms: ClassVar[Literal[False]] = False
    parts: Shaped
    log_weight: Float[Tensor, "*batch parts"]

    @classmethod
    def about(cls, parts: ProjectedHuber, log_weight: Float[Tensor, "*batch parts"]) -> "GaussianMixture":
        """With the modes, axes and precisions of Projected Huber densities."""
        return cls(Shaped(Whitening(parts, 1), NormalLaw()), log_weight)

    @property
    def _weight(self) -> Float[Tensor, "*batch parts"]:
        return self.log_weight.softmax(-1)

    def _average(self, values: Float[Tensor, "*#batch parts"]) -> Float[Tensor, "*#batch"]:
        return (self._weight * values).sum(-1)

    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        return (self.parts.log_prob(value[..., None, :]) + self.log_weight.log_softmax(-1)).logsumexp(-1)

    @torch.no_grad()
    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """The share of the density that is higher than here, by 512 quasi-random draws of each Gaussian.

        It errs by less than 0.01. Source: own derivation; checked in tests/distributions/test_laws.py.
        """
        log_p, batch = self.log_prob(xyz), self.log_weight.ndim - 1
        normal = _normal_draws().to(log_p).reshape(-1, *[1] * (batch + 1), 3)
        drawn = torch.cat([self._log_prob_of_draws(part) for part in normal.split(_AT_ONCE)])
        drawn, order = drawn.flatten(0, 1).movedim(0, -1).sort(dim=-1)
        weight = self._weight.repeat(*[1] * batch, _DRAWS).gather(-1, order) / _DRAWS
        above = pad(weight.flip(-1).cumsum(-1).flip(-1), (0, 1))
        lead = log_p.shape[: log_p.ndim - batch]
        at = log_p.reshape(lead.numel(), *log_p.shape[len(lead) :]).movedim(0, -1)
        place = torch.searchsorted(drawn.contiguous(), at.contiguous(), right=True)
        return above.gather(-1, place).movedim(-1, 0).reshape(log_p.shape)

    def _log_prob_of_draws(self, normal: Tensor) -> Float[Tensor, "draws parts *batch"]:
        drawn = self.parts.whitening.position(normal[..., :2], normal[..., 2])
        return self.log_prob(drawn.movedim(-2, 1))

    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        drawn = self.parts.rsample(sample_shape, generator)
        p = torch.rand(drawn.shape[:-2], generator=generator, dtype=drawn.dtype, device=drawn.device)
        which = (p[..., None] > self._weight.cumsum(-1)[..., :-1]).sum(-1)
        return drawn.gather(-2, which[..., None, None].expand(*which.shape, 1, 3)).squeeze(-2)

    @property
    @torch.no_grad()
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The highest of the maxima that are found from each Gaussian's, metres.

        At a maximum, v is the mean of the Gaussians' modes, weighted with their densities and inverse covariances.
        """
        # in float64, and without covariances: a network may make them so wide or narrow that they have no inverse
        around = self.parts.whitening.around
        root = around.measure.double() * pad(around.a.double()[..., None], (2, 0), value=1)[..., None]  # to (q, a t)
        inverse = root.mT @ root
        pull = (inverse @ self.parts.mode.double()[..., None]).squeeze(-1)
        found = self.parts.mode.movedim(-2, 0)  # the starts come first
        for _ in range(_STEPS):
            share = (self.parts.log_prob(found[..., None, :]) + self.log_weight).softmax(-1)
            total = (share[..., None, None] * inverse).sum(-3)
            moved = torch.linalg.solve_ex(total, (share[..., None] * pull).sum(-2)).result.to(found)
            found = torch.where(moved.isfinite(), moved, found)
        best = self.log_prob(found).argmax(0)
        return found.gather(0, best[None, ..., None].expand(1, *best.shape, 3)).squeeze(0)

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        """The mean of the Gaussians' centres; their rays have no mean."""
        return (self._weight[..., None] * self.parts.mu_xy).sum(-2)

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        """By the Gaussians' linearisations about their modes."""
        return self._covariance(self.parts.projected_covariance, self.parts.mu_xy)

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        return (self._weight[..., None] * self.parts.mode).sum(-2)

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        return self._covariance(self.parts.covariance_matrix, self.parts.mode)

    def _covariance(self, within: Tensor, centre: Tensor) -> Tensor:
        """The mean covariance of the Gaussians, and the covariance of their centres."""
        weight = self._weight[..., None]
        apart = centre - (weight * centre).sum(-2, keepdim=True)
        return (weight[..., None] * (within + apart[..., :, None] * apart[..., None, :])).sum(-3)

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        return self.mean[..., 2]

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        return self.covariance_matrix[..., 2, 2]

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        return self._average(self.parts.depth_cdf(z[..., None]))

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        """By bisection."""
        p = torch.as_tensor(p).to(self.log_weight)
        ends = self.parts.depth_icdf(p[..., None])
        return quantile_between(self.depth_cdf, p, ends)

    def depth_crps(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """E|Z - z| - E|Z - Z'|/2 with closed forms for each pair of Gaussians.

        Source: Grimit et al., "The continuous ranked probability score for circular variables" (2006).
        """
        mean, variance = self.parts.depth_mean, self.parts.depth_variance
        apart = mean[..., :, None] - mean[..., None, :]
        between = _mean_distance(apart, variance[..., :, None] + variance[..., None, :])
        spread = self._average((self._weight[..., None, :] * between).sum(-1))
        return self._average(_mean_distance(z[..., None] - mean, variance)) - spread / 2


@cache
def _normal_draws() -> Float[Tensor, "draws 3"]:
    """Quasi-random draws of three normal variables."""
    uniform = SobolEngine(3, scramble=True, seed=0).draw(_DRAWS, dtype=torch.float64)
    return torch.special.ndtri(uniform.clamp(1e-9, 1 - 1e-9))


def _mean_distance(mean: Tensor, variance: Tensor) -> Tensor:
    """E|X| of a normal X."""
    deviation = variance.sqrt()
    x = mean / deviation
    return mean * (2 * torch.special.ndtr(x) - 1) + 2 * deviation * _NORMAL.log_prob(x).exp()
