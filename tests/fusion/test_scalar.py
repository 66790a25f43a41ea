"""The compiled solver of a CPU against the batched one of a GPU, on the same problems."""

import pytest
import torch
from torch.testing import assert_close

from phd_exp.fusion import Plane, newton, solver
from phd_exp.fusion import polish as polishing
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.views import Views
from tests.fusion.random_problems import random_problems

N = 300
LEAST = 1e-2


def views_of(cameras: int, on_a_plane: bool, masked: bool) -> Views:
    predictions, pose, truth = random_problems(N, cameras, seed=cameras)
    random = torch.Generator().manual_seed(1)
    mask = torch.rand(N, cameras, generator=random) < 0.7 if masked else None
    if mask is not None:
        mask[:, 0] = True
    normal = torch.randn(N, 3, generator=random, dtype=torch.float64)
    plane = Plane(normal, (normal * truth).sum(-1)) if on_a_plane else None
    return Problems.posed(predictions, pose, plane, mask).views()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("on_a_plane", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 5])
def test_both_find_the_same(cameras: int, on_a_plane: bool, masked: bool) -> None:
    views = views_of(cameras, on_a_plane, masked)
    start = torch.zeros_like(views.slope[0, :, 0])
    u, lam = newton.minimise(views, start, LEAST)
    mine_u, mine_lam = solver.minimise(views, start, LEAST)
    assert_close(mine_u, u, rtol=0, atol=1e-9)
    polished, multipliers = polishing.polish(views, u, lam)
    mine_u, mine_multipliers = solver.polish(views, mine_u, mine_lam)
    assert_close(mine_u, polished, rtol=0, atol=1e-12)
    assert_close(mine_multipliers, multipliers, rtol=0, atol=1e-6)


def test_what_it_is_given_stays() -> None:
    views = views_of(3, on_a_plane=False, masked=False)
    start = torch.ones_like(views.slope[0, :, 0]) / 10
    before, lam = start.clone(), torch.zeros_like(views.a)
    solver.minimise(views, start, LEAST)
    solver.polish(views, start, lam)
    assert torch.equal(start, before)
    assert not lam.any()


def test_no_problem_depends_on_its_neighbours() -> None:
    views = views_of(4, on_a_plane=False, masked=False)
    start = torch.zeros_like(views.slope[0, :, 0])
    some = torch.arange(5, N, 7)
    together, alone = (
        solver.minimise(views, start, LEAST),
        solver.minimise(views.subset(some), start[:, some], LEAST),
    )
    assert torch.equal(together[0][:, some], alone[0])
    assert torch.equal(together[1][:, some], alone[1])
