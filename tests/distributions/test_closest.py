"""The Projected Huber density closest to a Student's t."""

import math

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.shaped import StudentT, closest_to_student

RAW = torch.tensor([0.3, -0.1, 30, 5, 60, 5e4, 0.5], dtype=torch.float64)
AXIS = [0.8, -0.4]  # of a density so narrow in depth that near and far have equal laws
AROUND = ProjectedHuber.from_raw(RAW, f=1550.0, S=224.0, mu_z0=2.5e-3)


@pytest.mark.parametrize("freedom", [2.2, 3.0, 6.0, 30.0, 1e6])
def test_no_other_temperatures_give_samples_a_higher_likelihood(freedom: float) -> None:
    further = torch.tensor([*AXIS, freedom - 3 if freedom > 3 else math.log(freedom - 2)]).double()
    xyz = StudentT(AROUND, further).rsample((100_000,), torch.Generator().manual_seed(0))
    closest = closest_to_student(AROUND, further)

    def mean_nll(projected: float, depth: float) -> float:
        inside = xyz[:, 2] > 0  # the Student's t reaches behind the camera
        return -float(closest.tempered(projected, depth).log_prob(xyz[inside]).mean())

    best = mean_nll(1.0, 1.0)
    for step in (0.93, 1.07):
        assert best < mean_nll(step, 1.0)
        assert best < mean_nll(1.0, step)


def test_mode_and_axis_stay() -> None:
    further = torch.tensor([*AXIS, 0.5]).double()
    closest, turned = closest_to_student(AROUND, further), AROUND.with_axis(further[:2])
    for name in ("mode", "m_xy", "apex"):
        torch.testing.assert_close(getattr(closest, name), getattr(turned, name))
