"""The Projected Huber density closest to a Student's t."""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.shaped import student_freedom

ROUNDING = 2.0
"""The rounding of `model=rounded_t`, chosen by the NLL of held-out samples."""
# log factors of A and a, as polynomials in 1/n: least squares over n >= 2, within 1e-3
_LOG_PROJECTED = (0.48232, -0.75329, -0.29228, -0.83828)
_LOG_DEPTH = (0.60748, -0.82139, -0.31717, -0.97420)


def closest_to_student(around: ProjectedHuber, further: Float[Tensor, "*batch 3"]) -> ProjectedHuber:
    """The density that gives samples of `shaped.StudentT(around, further)` the highest likelihood.

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
