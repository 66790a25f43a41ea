"""Densities of other shapes around the parameters (mu_xy, mu_z, A, a) of a Projected Huber density.

A `Whitening` turns a position into two variables q and s, and a `Law` gives their density. The seven raw numbers are
the same, so that only the law differs.

Source: own derivation; tests/distributions/test_laws.py checks every density.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.distributions import spd
from phd_exp.distributions.density import Density
from phd_exp.distributions.laws import HuberLaw, Law, NormalLaw, Number, Pair, StudentLaw
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.geometry.camera import at_depth

ROUNDING = 2.0
"""The rounding of `model=rounded_t`, chosen by the NLL of held-out samples."""
# log factors of A and a, as polynomials in 1/n: least squares over n >= 2, within 1e-3
_LOG_PROJECTED = (0.48232, -0.75329, -0.29228, -0.83828)
_LOG_DEPTH = (0.60748, -0.82139, -0.31717, -0.97420)


@final
@dataclass(frozen=True)
class Whitening:
    """The map from positions to (q, s), with q and t = z/mu_z of a Projected Huber density.

    Args:
        around: provides the parameters; it may have a free axis for an exponent of 1 alone.
        exponent: 1 for s = a (t - 1), where positions fill all space; 0 for s = a log t with the ray q/t in place of
            q, where z > 0.
    """

    around: ProjectedHuber
    exponent: int

    def variables(self, xyz: Float[Tensor, "*#batch 3"]) -> tuple[Pair, Number, Number, Bool[Tensor, "*#batch"]]:
        """q and s of a position (metres), the log of their volume per cubic metre, and whether it has them."""
        around, visible = self.around, self._has_variables(xyz[..., 2])
        volume = around.log_det_A + around.a.log() - 3 * around.mu_z.log()
        xyz = torch.where(visible[..., None], xyz, around.mode)  # so that no NaN is multiplied by a zero gradient
        q, s = around.whiten(xyz), self._s(xyz[..., 2])
        if self.exponent == 1:
            return q, s, volume, visible
        t = xyz[..., 2] / around.mu_z
        return q / t[..., None], s, volume - 3 * t.log(), visible

    def s(self, z: Number) -> tuple[Number, Bool[Tensor, "*#batch"]]:
        """s of a depth (metres), and whether it has one."""
        visible = self._has_variables(z)
        return self._s(torch.where(visible, z, self.around.mu_z)), visible

    def _has_variables(self, z: Tensor) -> Tensor:
        return (z > 0) | (self.exponent == 1)

    def _s(self, z: Tensor) -> Tensor:
        t = z / self.around.mu_z
        return self.around.a * (t - 1 if self.exponent else t.log())

    def z(self, s: Number) -> Number:
        """The depth of s, metres."""
        excess = s / self.around.a
        return self.around.mu_z * (1 + excess if self.exponent else excess.exp())

    def position(self, q: Pair, s: Number) -> Float[Tensor, "*#batch 3"]:
        """The position of q and s, metres."""
        z, around = self.z(s), self.around
        across = (around.mu_z if self.exponent == 1 else z)[..., None] * spd.matvec(self.A_inverse, q)
        return around.apex + at_depth(around.m_xy, z) + pad(across, (0, 1))

    @property
    def A_inverse(self) -> Float[Tensor, "*batch 2 2"]:
        """A^(-1), which scales q to (x, y)/z."""
        return spd.inverse(self.around.A, self.around.log_det_A)


@final
@dataclass(frozen=True)
class Shaped(Density):
    """The density of positions whose variables have a law.

    With an exponent of 1, (x, y)/z has no moments; those of the linearisation about the mode replace them.
    """

    has_closed_forms: ClassVar[Literal[False]] = False
    whitening: Whitening
    law: Law

    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        q, s, volume, visible = self.whitening.variables(value)
        return (self.law.log_prob(q, s) + volume).masked_fill(~visible, -torch.inf)

    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """The probability of the law's smallest region of highest density that contains a position."""
        q, s, _, visible = self.whitening.variables(xyz)
        return self.law.level(q, s).masked_fill(~visible, 1)

    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        a = self.whitening.around.a
        return self.whitening.position(*self.law.draw((*sample_shape, *a.shape), a, generator))

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        return self.whitening.around.mode

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        return self.whitening.around.mu_xy

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        around = self.whitening.around
        along = (around.m_xy - around.mu_xy) / around.a[..., None]
        variance = torch.as_tensor(self.law.variance).to(along)[..., None, None]
        return variance * (spd.square(self.whitening.A_inverse) + along[..., :, None] * along[..., None, :])

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        return self.whitening.around.mu_z if self.whitening.exponent else super().depth_mean

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        around = self.whitening.around
        if self.whitening.exponent:
            return self.law.depth_variance * (around.mu_z / around.a).square()
        return super().depth_variance

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """Covariance of the position, m^2."""
        if self.whitening.exponent != 1:
            return super().covariance_matrix
        around = self.whitening.around
        m = pad(around.m_xy, (0, 1), value=1)
        across = torch.as_tensor(self.law.variance).to(m)[..., None, None] * spd.square(self.whitening.A_inverse)
        across = pad(around.mu_z.square()[..., None, None] * across, (0, 1, 0, 1))
        return self.depth_variance[..., None, None] * (m[..., :, None] * m[..., None, :]) + across

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        s, visible = self.whitening.s(z)
        return self.law.cdf(s).masked_fill(~visible, 0)

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        return self.whitening.z(self.law.icdf(torch.as_tensor(p).to(self.whitening.around.a)))


# what conf/model names: from the density of the seven raw numbers, and further raw numbers


def Gaussian(around: ProjectedHuber, further: Float[Tensor, "*batch n"]) -> Shaped:
    """A Gaussian in space with any covariance; positions behind the camera have their share of it."""
    return Shaped(Whitening(around.with_axis(further[..., :2]), 1), NormalLaw())


def StudentT(around: ProjectedHuber, further: Float[Tensor, "*batch n"]) -> Shaped:
    """Student's t in space with any scale matrix and 2 + phi(third further number) degrees of freedom."""
    law = StudentLaw(student_freedom(further[..., 2]))
    return Shaped(Whitening(around.with_axis(further[..., :2]), 1), law)


def student_freedom(raw: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The degrees of freedom of a raw number, more than 2, so that variances exist."""
    return 2 + spd.positive(raw)


def Decomposed(around: ProjectedHuber, _: Tensor) -> Shaped:
    """Ray and depth of the Projected Huber density, independent of each other: p(x/z, y/z) p(z)/z^2.

    Source: paper, Proposition 1: no density that decomposes in this way satisfies all seven constraints.
    """
    return Shaped(Whitening(around, 0), HuberLaw(around.a))


def closest_to_student(around: ProjectedHuber, further: Float[Tensor, "*batch 3"]) -> ProjectedHuber:
    """The density that gives samples of `StudentT(around, further)` the highest likelihood.

    It has a free axis and a rounded mode.

    Mode and axis stay, since both laws are symmetric about them. A and a are multiplied by factors that depend on the
    degrees of freedom n alone. That of A is the c with E[c r h'(c r)] = 2, where r is the radius of the projection of
    a standard Student's t. That of a is the c with E[c |s| e'(c |s|)] = 1, where s is its depth and e the energy of
    depth, sqrt(s^2 + ROUNDING^2). Both are exact in the limit of a large a, where
    depths in front of the mode and behind it have the same law.

    Source: own derivation; tests/distributions/test_closest.py checks the factors by samples.
    """
    inverse = 1 / student_freedom(further[..., 2])
    projected, depth = (_polynomial(c, inverse).neg().exp() for c in (_LOG_PROJECTED, _LOG_DEPTH))
    return around.with_axis(further[..., :2]).tempered(projected, depth).with_rounding(ROUNDING)


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    total = torch.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total
