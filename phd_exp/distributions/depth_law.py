"""The law of t = z / mu_z: that of the paper, whose density has a kink at its mode, or one with a rounded mode."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import depth
from phd_exp.distributions.level import credible_level
from phd_exp.distributions.special import log_scaled_normaliser

Numbers = Float[Tensor, "*#batch"]


class DepthLaw(ABC):
    """The law of t, whose density is proportional to exp(-energy); energies are 0 at the mode t = 1.

    Arguments are logarithms of t and of a, the precision of z: they stay finite where a or t underflows.
    """

    log_a: Numbers

    @abstractmethod
    def energy(self, log_t: Numbers) -> Numbers:
        """The excess energy >= 0."""

    @abstractmethod
    def farthest_log_t(self, energy: Numbers) -> Numbers:
        """The log t >= 0 with this excess energy; that of 1/t is the same."""

    @property
    @abstractmethod
    def log_normaliser(self) -> Numbers:
        """log int exp(-energy) dt."""

    @abstractmethod
    def level(self, energy: Numbers) -> Numbers:
        """P(h(|q|) + energy of t <= `energy`), in [0, 1]: a credible level of the density of positions."""

    @abstractmethod
    def cdf(self, log_t: Numbers) -> Numbers:
        """The probability of depths up to t."""

    @abstractmethod
    def icdf(self, p: Numbers) -> Numbers:
        """The log t with this probability of smaller depths, for p in [0, 1]; differentiable once, in p and a."""

    @property
    @abstractmethod
    def excess_moments(self) -> tuple[Numbers, Numbers]:
        """Mean and variance of a (t - 1)."""

    @property
    def moments(self) -> tuple[Numbers, Numbers]:
        """Mean and variance of t."""
        mean, variance = self.excess_moments
        a = self.log_a.exp()
        return 1 + mean / a, variance / a.square()

    @property
    @abstractmethod
    def inverse_moments(self) -> tuple[Numbers, Numbers]:
        """1 - E[1/t] and Var[1/t]."""

    @property
    @abstractmethod
    def mean_energy(self) -> Numbers:
        """The mean excess energy."""

    @abstractmethod
    def slope(self, log_t: Numbers) -> Numbers:
        """The derivative of the energy with respect to log a; that of `log_normaliser` is -`mean_slope`."""

    @property
    @abstractmethod
    def mean_slope(self) -> Numbers:
        """The mean of `slope` over the law."""

    @abstractmethod
    def crps_beyond_distance(self, log_t: Numbers) -> Numbers:
        """a (CRPS(t) - |t - 1|): the score minus the distance from the mode, in units of 1/a."""


@final
@dataclass(frozen=True)
class Kinked(DepthLaw):
    """The law of the paper, with the energy a max(t, 1/t); closed forms of `phd_exp.distributions.depth`."""

    log_a: Numbers

    def energy(self, log_t: Numbers) -> Numbers:
        return depth.depth_energy(log_t, self.log_a)

    def farthest_log_t(self, energy: Numbers) -> Numbers:
        return torch.log1p(energy / self.log_a.exp())

    @property
    def log_normaliser(self) -> Numbers:
        return log_scaled_normaliser(self.log_a)

    def level(self, energy: Numbers) -> Numbers:
        return credible_level(energy, self.log_a.exp())

    def cdf(self, log_t: Numbers) -> Numbers:
        return depth.depth_cdf(log_t, self.log_a)

    def icdf(self, p: Numbers) -> Numbers:
        return depth.depth_icdf(p, self.log_a)

    @property
    def excess_moments(self) -> tuple[Numbers, Numbers]:
        return depth.depth_excess_moments(self.log_a)

    @property
    def inverse_moments(self) -> tuple[Numbers, Numbers]:
        shortfall = depth.inverse_depth_shortfall(self.log_a.exp())
        return shortfall, shortfall * (2 - shortfall)  # E[1/t^2] = 1

    @property
    def mean_energy(self) -> Numbers:
        return depth.depth_mean_energy(self.log_a)

    def slope(self, log_t: Numbers) -> Numbers:
        return self.energy(log_t)

    @property
    def mean_slope(self) -> Numbers:
        return self.mean_energy

    def crps_beyond_distance(self, log_t: Numbers) -> Numbers:
        return depth.crps_beyond_distance(log_t, self.log_a)
