"""The interface of laws of t = z / mu_z: `Kinked` is the paper's, `Rounded` has a rounded mode."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor

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
        """Mean and variance of a (t - 1), the depth beyond the mode in units of the law's width."""

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
    def crps_beyond_distance(self, log_t: Numbers) -> Numbers:
        """a (CRPS(t) - |t - 1|): the score minus the distance from the mode, in units of 1/a.

        The continuous ranked probability score is int (F(u) - 1[u >= t])^2 du = E|T - t| - E|T - T'|/2.
        """
