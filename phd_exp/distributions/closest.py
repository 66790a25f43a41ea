"""The Projected Huber density closest to a Student's t."""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.shaped import student_freedom

# log factors of A and a, as polynomials in 1/n: least squares over n >= 2, within 5e-4
_LOG_PROJECTED = (0.48232, -0.75329, -0.29228, -0.83828)
_LOG_DEPTH = (0.22614, -0.77194, -0.30254, -0.88518)


def closest_to_student(around: ProjectedHuber, further: Float[Tensor, "*batch 3"]) -> ProjectedHuber:
    """The density with a free axis that gives samples of `shaped.StudentT(around, further)` the highest likelihood.

    Mode and axis stay, since both laws are symmetric about them. A and a are multiplied by factors c_q and c_s of the
    degrees of freedom n alone: c_s = 1/E|s|, and E[c r h'(c r)] = 2 at c = c_q, with s and r the depth and the radius
    of the projection of a standard Student's t. This is exact as a grows, where depths near and far have equal laws.

    Source: own derivation; tests/distributions/test_closest.py checks the factors by samples.
    """
    inverse = 1 / student_freedom(further[..., 2])
    projected, depth = (_polynomial(c, inverse).neg().exp() for c in (_LOG_PROJECTED, _LOG_DEPTH))
    return around.with_axis(further[..., :2]).tempered(projected, depth)


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    total = torch.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total
