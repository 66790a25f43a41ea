"""Laws of the variables of a `Whitening`: q, two numbers with an isotropic law, and s, one number for depth.

tests/distributions/test_laws.py checks every law.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, final

import torch
from jaxtyping import Float
from scipy import special
from torch import Tensor
from torch.distributions import Normal

from phd_exp.distributions import huber
from phd_exp.distributions.kinked import Kinked

Pair = Float[Tensor, "*#batch 2"]
Number = Float[Tensor, "*#batch"]
_NORMAL = Normal(0.0, 1.0, validate_args=False)  # a check waits for a GPU


class Law(ABC):
    """The law of q and s; both are 0 where its density is highest.

    Attributes:
        variance: of each component of q.
        depth_variance: of s; an exponent of 0 does not need it.
    """

    variance: ClassVar[Any] = 1.0
    depth_variance: ClassVar[Any] = 1.0

    @abstractmethod
    def log_prob(self, q: Pair, s: Number) -> Number:
        """Log density of both."""

    @abstractmethod
    def level(self, q: Pair, s: Number) -> Number:
        """The probability of the smallest region of highest density that contains both."""

    @abstractmethod
    def cdf(self, s: Number) -> Number:
        """The probability of smaller s."""

    @abstractmethod
    def icdf(self, p: Number) -> Number:
        """The s of which smaller ones have the probability p."""

    def draw(self, shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> tuple[Pair, Number]:
        """Samples of the data type and on the device of `like`; by default q is standard normal."""
        kind: Any = {"dtype": like.dtype, "device": like.device, "generator": generator}
        p = torch.rand(*shape, **kind).clamp_min(torch.finfo(like.dtype).eps / 2)
        return torch.randn(*shape, 2, **kind), self.icdf(p)


@final
class NormalLaw(Law):
    """Three independent standard normal variables."""

    def log_prob(self, q: Pair, s: Number) -> Number:
        return _NORMAL.log_prob(q).sum(-1) + _NORMAL.log_prob(s)

    def level(self, q: Pair, s: Number) -> Number:
        energy = (q.square().sum(-1) + s.square()) / 2
        return torch.special.gammainc(torch.full_like(energy, 1.5), energy)

    def cdf(self, s: Number) -> Number:
        return torch.special.ndtr(s)

    def icdf(self, p: Number) -> Number:
        return torch.special.ndtri(p)


@final
@dataclass(frozen=True)
class StudentLaw(Law):
    """Student's t in three dimensions.

    Args:
        freedom: degrees of freedom n > 2, so that variances exist.

    Source: Kotz and Nadarajah, "Multivariate t distributions and their applications" (2004).
    """

    freedom: Float[Tensor, "*batch"]

    def log_prob(self, q: Pair, s: Number) -> Number:
        n = self.freedom
        constant = torch.lgamma((n + 3) / 2) - torch.lgamma(n / 2) - 1.5 * (math.pi * n).log()
        return constant - (n + 3) / 2 * torch.log1p((q.square().sum(-1) + s.square()) / n)

    def level(self, q: Pair, s: Number) -> Number:
        squared, n = q.square().sum(-1) + s.square(), self.freedom
        return _by_scipy(lambda n, x: special.betainc(1.5, n / 2, x), n, squared / (n + squared))

    def cdf(self, s: Number) -> Number:
        return _by_scipy(special.stdtr, self.freedom, s)

    def icdf(self, p: Number) -> Number:
        return _by_scipy(special.stdtrit, self.freedom, p)

    def draw(self, shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> tuple[Pair, Number]:
        normal, s = super().draw(shape, like, generator)
        n, squared = self.freedom, normal.square().sum(-1)
        # given s, |q|^2/(n + s^2) + 1 is a power of a uniform variable, which exp(-squared/2) is
        ratio = (n + s.square()) * torch.expm1(squared / (n + 1)) / squared
        return normal * ratio.sqrt()[..., None], s

    @property
    def variance(self) -> Float[Tensor, "*batch"]:
        # finite where n - 2 is lost in rounding
        return self.freedom / (self.freedom - 2).clamp_min(torch.finfo(self.freedom.dtype).eps)

    depth_variance = variance


@final
@dataclass(frozen=True)
class HuberLaw(Law):
    """q and s = a log t of the Projected Huber density, independent of each other."""

    a: Float[Tensor, "*batch"]
    variance = huber.HUBER_COVARIANCE

    @property
    def _depth(self) -> Kinked:
        return Kinked(self.a.log())

    def log_prob(self, q: Pair, s: Number) -> Number:
        log_t = s / self.a  # dt = t ds / a
        normaliser = huber.HUBER_LOG_NORMALISER + self._depth.log_normaliser + self.a.log()
        return log_t - huber.huber_energy(q) - self._depth.energy(log_t) - normaliser

    def level(self, q: Pair, s: Number) -> Number:
        return self._depth.level(huber.huber_energy(q) + self._depth.energy(s / self.a))

    def cdf(self, s: Number) -> Number:
        return self._depth.cdf(s / self.a)

    def icdf(self, p: Number) -> Number:
        return self.a * self._depth.icdf(p)

    def draw(self, shape: Sequence[int], like: Tensor, generator: torch.Generator | None) -> tuple[Pair, Number]:
        _, s = super().draw(shape, like, generator)
        return huber.sample_whitened(s.shape, dtype=s.dtype, device=s.device, generator=generator), s


def _by_scipy(function: Callable[..., Any], *values: Tensor) -> Tensor:
    """A function that torch lacks, without gradients."""
    found = function(*(value.detach().double().cpu().numpy() for value in values))
    return torch.as_tensor(found).to(values[-1])
