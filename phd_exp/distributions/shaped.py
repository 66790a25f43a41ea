"""Densities of other shapes around the parameters (mu_xy, mu_z, A, a) of a Projected Huber density.

With q and t = z/mu_z of that density and s = a (t^e - 1)/e (a log t for e = 0), each is a law of (q + k s, s) in
space for e = 1, or of the ray q/t and s for e < 1. The seven raw numbers are the same, so that only the law differs.

Source: own derivation; tests/distributions/test_heads.py checks every law.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from scipy import special
from torch import Tensor
from torch.distributions import Laplace, Normal
from torch.nn.functional import pad

from phd_exp.distributions import depth, huber, spd
from phd_exp.distributions.density import Density
from phd_exp.distributions.level import credible_level
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.special import log_scaled_normaliser
from phd_exp.geometry.camera import at_depth

_NORMAL, _LAPLACE = Normal(0.0, 1.0), Laplace(0.0, 1.0)


@dataclass(frozen=True)
class Shaped(Density):
    """A density in front of the camera, or in all space for e = 1; a subclass gives e and the law.

    Unless the subclass changes it, q and s are independent standard normal variables.

    Args:
        law: provides the parameters.
        further: raw numbers beyond its seven; the first two are k if e = 1.
    """

    has_closed_forms: ClassVar[Literal[False]] = False
    law: ProjectedHuber
    further: Float[Tensor, "*batch n"]
    exponent: ClassVar[int]

    def _log_law(self, q: Tensor, s: Tensor) -> Tensor:
        return _NORMAL.log_prob(q).sum(-1) + _NORMAL.log_prob(s)

    def _level(self, q: Tensor, s: Tensor) -> Tensor:
        energy = (q.square().sum(-1) + s.square()) / 2
        return torch.special.gammainc(torch.full_like(energy, 1.5), energy)

    def _cdf(self, s: Tensor) -> Tensor:
        return torch.special.ndtr(s)

    def _icdf(self, p: Tensor) -> Tensor:
        return torch.special.ndtri(p)

    def _draw(self, shape: Sequence[int], generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        like: Any = {"dtype": self.law.a.dtype, "device": self.law.a.device, "generator": generator}
        p = torch.rand(*shape, **like).clamp_min(torch.finfo(self.law.a.dtype).eps / 2)
        return torch.randn(*shape, 2, **like), self._icdf(p)

    _variance: ClassVar[Any] = 1.0  # of each component of q + k s

    @property
    def _spread(self) -> tuple[Tensor, Tensor]:
        """A^(-1), and A^(-1) k."""
        inverse = spd.inverse(self.law.A, self.law.log_det_A)
        return inverse, spd.matvec(inverse, self.further[..., :2]) if self.exponent == 1 else inverse[..., 0] * 0

    def _s(self, z: Tensor) -> Tensor:
        t, e = z / self.law.mu_z, self.exponent
        return self.law.a * ((t**e - 1) / e if e else t.log())

    def _z(self, s: Tensor) -> Tensor:
        excess, e = s / self.law.a, self.exponent
        return self.law.mu_z * ((1 + e * excess) ** e if e else excess.exp())

    def _whitened(self, xyz: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The variables of the law, the log of their volume per cubic metre, and where there is a density."""
        law, e = self.law, self.exponent
        volume, visible = law.log_det_A + law.a.log() - 3 * law.mu_z.log(), (xyz[..., 2] > 0) | (e == 1)
        xyz = torch.where(visible[..., None], xyz, law.mode)  # so that no NaN is multiplied by a zero gradient
        q, s = law.whiten(xyz), self._s(xyz[..., 2])
        if e == 1:
            return q + self.further[..., :2] * s[..., None], s, volume, visible
        t = xyz[..., 2] / law.mu_z
        return q / t[..., None], s, volume + (e - 3) * t.log(), visible

    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Log density of a position (metres), nats per cubic metre; -inf for z <= 0 unless e = 1."""
        q, s, volume, visible = self._whitened(value)
        return (self._log_law(q, s) + volume).masked_fill(~visible, -torch.inf)

    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """The probability of the law's smallest region of highest density that contains a position."""
        q, s, _, visible = self._whitened(xyz)
        return self._level(q, s).masked_fill(~visible, 1)

    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        q, s = self._draw((*sample_shape, *self.law.batch_shape), generator)
        z, (inverse, along) = self._z(s), self._spread
        shift = spd.matvec(inverse, q) - along * s[..., None]
        at = self.law.mu_z if self.exponent == 1 else z
        return at_depth(self.law.mu_xy, z) + pad(at[..., None] * shift, (0, 1))

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        return self.law.mode

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        return self.law.mu_xy

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        """Covariance of (x, y)/z; for e = 1, where it has none, of its linearisation about the mode."""
        inverse, along = self._spread
        return torch.as_tensor(self._variance)[..., None, None] * (spd.square(inverse) + _outer(along, along))

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        return self.law.mu_z if self.exponent == 1 else super().depth_mean

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        if self.exponent == 1:
            return self._variance * (self.law.mu_z / self.law.a).square()
        return super().depth_variance

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """Covariance of the position, m^2."""
        if self.exponent != 1:
            return super().covariance_matrix
        m, along = pad(self.mu_xy, (0, 1), value=1), pad(self._spread[1], (0, 1)) * self.law.a[..., None]
        across = pad(self.law.mu_z.square()[..., None, None] * self.projected_covariance, (0, 1, 0, 1))
        return self.depth_variance[..., None, None] * (_outer(m, m) - _outer(m, along) - _outer(along, m)) + across

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        visible = (z > 0) | (self.exponent == 1)
        return self._cdf(self._s(torch.where(visible, z, self.law.mu_z))).masked_fill(~visible, 0)

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        return self._z(self._icdf(torch.as_tensor(p).to(self.law.a)))


class Gaussian(Shaped):
    """A Gaussian in space with any covariance; positions behind the camera have their share of it."""

    exponent = 1


class StudentT(Shaped):
    """Student's t in space with any scale matrix and n = 2 + phi(third further number) degrees of freedom.

    Source: Kotz and Nadarajah, "Multivariate t distributions and their applications" (2004).
    """

    exponent = 1

    @property
    def freedom(self) -> Float[Tensor, "*batch"]:
        """Degrees of freedom n > 2, so that variances exist."""
        return 2 + spd.positive(self.further[..., 2])

    def _log_law(self, q: Tensor, s: Tensor) -> Tensor:
        n = self.freedom
        constant = torch.lgamma((n + 3) / 2) - torch.lgamma(n / 2) - 1.5 * (math.pi * n).log()
        return constant - (n + 3) / 2 * torch.log1p((q.square().sum(-1) + s.square()) / n)

    def _level(self, q: Tensor, s: Tensor) -> Tensor:
        squared, n = q.square().sum(-1) + s.square(), self.freedom
        return _by_scipy(lambda n, x: special.betainc(1.5, n / 2, x), n, squared / (n + squared))

    def _cdf(self, s: Tensor) -> Tensor:
        return _by_scipy(special.stdtr, self.freedom, s)

    def _icdf(self, p: Tensor) -> Tensor:
        return _by_scipy(special.stdtrit, self.freedom, p)

    def _draw(self, shape: Sequence[int], generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        normal, s = super()._draw(shape, generator)
        n, squared = self.freedom, normal.square().sum(-1)
        # given s, |q|^2/(n + s^2) + 1 is a power of a uniform variable, which exp(-squared/2) is
        ratio = (n + s.square()) * torch.expm1(squared / (n + 1)) / squared
        return normal * ratio.sqrt()[..., None], s

    @property
    def _variance(self) -> Tensor:
        return self.freedom / (self.freedom - 2)


class LogDepthGaussian(Shaped):
    """A Gaussian of the ray and, independently, of log z."""

    exponent = 0


class InverseDepthLaplace(Shaped):
    """A Gaussian of the ray and, independently, Laplace's law of 1/z > 0.

    z has no moments: `depth_mean` and `depth_variance` are those of the linearisation of z about mu_z.
    """

    exponent = -1

    @property
    def _in_front(self) -> Tensor:
        return _LAPLACE.cdf(self.law.a)

    def _log_law(self, q: Tensor, s: Tensor) -> Tensor:
        return _NORMAL.log_prob(q).sum(-1) + _LAPLACE.log_prob(s) - self._in_front.log()

    def _level(self, q: Tensor, s: Tensor) -> Tensor:
        energy = q.square().sum(-1) / 2 + s.abs()  # a sum of two exponential variables; that of s > 0 ends at a
        end, decay = torch.minimum(energy, self.law.a), torch.exp(-energy)
        return (2 - decay - torch.exp(-end) - (energy + end) * decay) / (2 * self._in_front)

    def _cdf(self, s: Tensor) -> Tensor:
        return _LAPLACE.cdf(s) / self._in_front

    def _icdf(self, p: Tensor) -> Tensor:
        return _LAPLACE.icdf(p * self._in_front)

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        return self.law.mu_z

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        return 2 * (self.law.mu_z / self.law.a).square()


class Decomposed(Shaped):
    """Ray and depth of the Projected Huber density, independent of each other: p(x/z, y/z) p(z)/z^2.

    Source: paper, Proposition 1: no density that decomposes in this way satisfies all seven constraints.
    """

    exponent = 0
    _variance = huber.HUBER_COVARIANCE

    def _energy(self, q: Tensor, s: Tensor) -> Tensor:
        return huber.huber_energy(q) + depth.depth_energy(s / self.law.a, self.law.a.log())

    def _log_law(self, q: Tensor, s: Tensor) -> Tensor:
        log_a = self.law.a.log()  # dt = t ds / a
        normaliser = huber.HUBER_LOG_NORMALISER + log_scaled_normaliser(log_a) + log_a
        return s / self.law.a - self._energy(q, s) - normaliser

    def _level(self, q: Tensor, s: Tensor) -> Tensor:
        return credible_level(self._energy(q, s), self.law.a)

    def _cdf(self, s: Tensor) -> Tensor:
        return depth.depth_cdf(s / self.law.a, self.law.a.log())

    def _icdf(self, p: Tensor) -> Tensor:
        return self.law.a * depth.depth_icdf(p, self.law.a.log())

    def _draw(self, shape: Sequence[int], generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        _, s = super()._draw(shape, generator)
        return huber.sample_whitened(s.shape, dtype=s.dtype, device=s.device, generator=generator), s


def _outer(x: Tensor, y: Tensor) -> Tensor:
    return x[..., :, None] * y[..., None, :]


def _by_scipy(function: Callable[..., Any], *values: Tensor) -> Tensor:
    """A function that torch lacks, without gradients."""
    found = function(*(value.detach().double().cpu().numpy() for value in values))
    return torch.as_tensor(found).to(values[-1])
