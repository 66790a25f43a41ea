"""The interface of all densities that a head may predict."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.geometry.camera import at_depth

_BISECTIONS = 60
_NODES = 400  # of quadrature over quantiles; relative errors are below 1e-3


class Density(ABC):
    """A density over positions v = (x, y, z) in the camera frame, metres, for each element of a batch.

    Training, records and reports use these members. The defaults for depth need `depth_icdf`.

    Attributes:
        has_covariance: whether views can be fused as Gaussians.
        has_closed_forms: whether it is a `ProjectedHuber`, as fusion, recalibration, level curves and intervals need.
    """

    has_covariance: ClassVar[bool] = True
    has_closed_forms: ClassVar[bool] = False

    @abstractmethod
    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Log density of a position (metres), nats per cubic metre; -inf where there is no density."""

    @abstractmethod
    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Credible level: the probability of the density's smallest region that contains a position."""

    @abstractmethod
    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        """Exact samples."""

    @property
    @abstractmethod
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The position of level 0, the point estimate, metres."""

    @property
    @abstractmethod
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        """Centre of (x, y)/z."""

    @property
    def projected_mean(self) -> Float[Tensor, "*batch 2"]:
        """Mean of (x, y)/z, which is mu_xy unless the axis is free."""
        return self.mu_xy

    @property
    @abstractmethod
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        """Covariance of (x, y)/z."""

    @abstractmethod
    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """P(depth <= z), z in metres."""

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        """The depth z, metres, with P(depth <= z) = p for p in (0, 1)."""
        raise NotImplementedError

    @property
    def depth_median(self) -> Float[Tensor, "*batch"]:
        """The median of z, metres."""
        return self.depth_icdf(0.5)

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        """E[z], metres."""
        p, weight = nodes(self.mode[..., 2])
        return (weight * self.depth_icdf(p)).sum(0)

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        """Var[z], square metres."""
        p, weight = nodes(self.mode[..., 2])
        return (weight * (self.depth_icdf(p) - self.depth_mean).square()).sum(0)

    def depth_crps(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """Continuous ranked probability score of a depth, metres: twice the mean pinball loss of all quantiles.

        Source: Koenker and Bassett, "Regression quantiles" (1978), for the loss.
        """
        p, weight = nodes(z)
        excess = z - self.depth_icdf(p)
        return 2 * (weight * torch.maximum(p * excess, (p - 1) * excess)).sum(0)

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        """Expected position, E[z] (mu_xy, 1), metres."""
        return at_depth(self.mu_xy, self.depth_mean)

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """Covariance of the position, m^2: for independent ray and depth Var[z] m m^T + E[z^2] Cov[(x, y)/z],
        with m = (mu_xy, 1).
        """
        m, variance = pad(self.mu_xy, (0, 1), value=1), self.depth_variance
        square = variance + self.depth_mean.square()
        ray = pad(square[..., None, None] * self.projected_covariance, (0, 1, 0, 1))
        return variance[..., None, None] * (m[..., :, None] * m[..., None, :]) + ray


def nodes(like: Float[Tensor, "*batch"]) -> tuple[Float[Tensor, "nodes ..."], Float[Tensor, "nodes ..."]]:
    """Probabilities and weights of a midpoint rule on (0, 1), dense at both ends, to broadcast with a batch."""
    angle = (torch.arange(_NODES, dtype=like.dtype, device=like.device) + 0.5) * (math.pi / _NODES)
    angle = angle.reshape(-1, *[1] * like.ndim)
    return (angle / 2).sin().square(), angle.sin() * (math.pi / 2 / _NODES)


def quantile_between(
    cdf: Callable[[Tensor], Tensor], p: Float[Tensor, "*#batch"], ends: Float[Tensor, "*#batch n"]
) -> Float[Tensor, "*batch"]:
    """The value of which smaller ones have the probability p, between the least and the largest of `ends`.

    By bisection, to the last bits.
    """
    low, high = ends.amin(-1), ends.amax(-1)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        is_low = cdf(middle) < p
        low, high = torch.where(is_low, middle, low), torch.where(is_low, high, middle)
    return high
