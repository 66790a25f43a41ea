"""The certificate is a bound, and it is not fooled."""

import torch

from phd_exp.fusion import fuse
from phd_exp.fusion.certificate import certify
from phd_exp.fusion.problems import Problems
from tests.fusion.random_problems import random_problems


def test_every_optimum_is_proven_within_a_micrometre() -> None:
    for cameras in (1, 2, 4, 8):
        predictions, pose, _ = random_problems(500, cameras, seed=7)
        fused = fuse(predictions, pose, contradiction=0.0)
        assert (fused.certificate < 1e-6).all()


def test_the_bound_holds_for_points_that_are_moved_off_the_optimum() -> None:
    """Whatever the multipliers: they only have to be allowed."""
    predictions, pose, _ = random_problems(1000, 4, seed=8)
    fused = fuse(predictions, pose, contradiction=0.0)
    problems = Problems.posed(predictions, pose, None, None)
    views = problems.views()
    generator = torch.Generator().manual_seed(0)
    bounded = 0
    for step in (1e-9, 1e-7, 1e-5, 1e-3):
        moved = fused.point + step * torch.nn.functional.normalize(
            torch.randn(1000, 3, generator=generator, dtype=torch.float64), dim=-1
        )
        lam = 2 * torch.rand(views.a.shape, generator=generator, dtype=torch.float64) - 1
        distance = certify(views, (moved - problems.origin).T, lam).distance
        bounded += int(distance.isfinite().sum())
        assert (distance >= step - 1e-6 - 1e-9 * step).all()
        assert (distance >= step - fused.certificate).all()
    assert bounded > 100
