"""The compiled steps of a CPU against the batched ones of a GPU, on the same problems."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from phd_exp.fusion import Plane, Pose, certificate, compiled, energy, moments, newton, solver
from phd_exp.fusion import polish as polishing
from phd_exp.fusion.compiled import moments as moments_compiled
from phd_exp.fusion.compiled import newton as newton_compiled
from phd_exp.fusion.compiled import posing
from phd_exp.fusion.compiled.__main__ import main
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.views import Views
from tests.fusion.random_problems import random_problems

N = 300
LEAST = 1e-2


def problems_of(cameras: int, on_a_plane: bool, masked: bool) -> Problems:
    predictions, pose, truth = random_problems(N, cameras, seed=cameras)
    random = torch.Generator().manual_seed(1)
    mask = torch.rand(N, cameras, generator=random) < 0.7 if masked else None
    if mask is not None:
        mask[:, 0] = True
    normal = torch.randn(N, 3, generator=random, dtype=torch.float64)
    plane = Plane(normal, (normal * truth).sum(-1)) if on_a_plane else None
    return Problems.posed(predictions, pose, plane, mask)


def views_of(cameras: int, on_a_plane: bool, masked: bool) -> Views:
    return problems_of(cameras, on_a_plane, masked).views()


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


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("on_a_plane", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 5])
def test_both_say_the_same_of_an_optimum(cameras: int, on_a_plane: bool, masked: bool) -> None:
    problems = problems_of(cameras, on_a_plane, masked)
    views, mine = problems.views(), solver.views(problems)
    for name in ("slope", "at_origin", "a"):
        assert_close(getattr(mine, name), getattr(views, name), rtol=1e-12, atol=1e-12)
    u, lam = solver.polish(views, *solver.minimise(views, torch.zeros_like(views.slope[0, :, 0]), LEAST))
    u = u + 1e-7 * torch.randn(u.shape, generator=torch.Generator().manual_seed(2), dtype=u.dtype)
    here, there = solver.certify(views, u, lam), certificate.certify(views, u, lam)
    for name in ("subgradient", "relative", "distance"):
        assert_close(getattr(here, name), getattr(there, name), rtol=1e-6, atol=1e-12)
    takes_part = views.a > 0
    expected = energy.surprise(views, u)[takes_part]
    assert_close(solver.surprise(views, u)[takes_part], expected, rtol=0, atol=1e-12)
    for ours, theirs in zip(solver.moments(views, u), moments.moments(views, u), strict=True):
        assert_close(ours, theirs, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["to_seen", "mode", "a", "R", "t"])
def test_both_find_the_same_faults(name: str) -> None:
    problems = problems_of(3, on_a_plane=False, masked=False)
    pose = Pose(problems.pose.R.contiguous(), problems.pose.t.contiguous())
    problems = dataclasses.replace(problems, pose=pose)
    spoilt = getattr(problems if hasattr(problems, name) else problems.pose, name)
    entries = spoilt.view(N, 3, -1)
    for row, value in enumerate(
        (torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1e308, -1e308, 1 + 1e-5, 1 + 1e-8)
    ):
        for entry in range(entries.shape[-1]):
            entries[9 * row + entry, row % 3, entry] = value
    problems.pose.R[200:, 1] *= -1  # mirrors
    sound, rigid = solver.soundness(problems)
    assert torch.equal(sound, problems.sound)
    assert torch.equal(rigid, problems.pose.is_rigid)
    assert not sound.all() or not rigid.all()
    assert sound[100:].all()


def test_levels_agree_where_depth_is_nearly_unknown_or_nearly_known() -> None:
    views = views_of(1, on_a_plane=False, masked=False)
    precise = torch.logspace(-12, 12, N, dtype=torch.float64)[None]
    views = Views(views.slope, views.at_origin, precise)
    u = torch.zeros_like(views.slope[0, :, 0])
    assert_close(solver.surprise(views, u), energy.surprise(views, u), rtol=0, atol=1e-12)


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


def test_everything_is_compiled_ahead_on_request() -> None:
    main()
    for module in (posing.views, newton_compiled.minimise, moments_compiled.moments):
        assert module.signatures


def test_what_was_compiled_of_other_sources_is_forgotten(tmp_path: Path) -> None:
    """By numba's own rule a function stays as it is while another file changes, on which it depends."""
    index = tmp_path / "fusion" / "compiled" / "__pycache__" / "step.nbi"
    index.parent.mkdir(parents=True)
    source = tmp_path / "distributions" / "level.py"
    source.parent.mkdir()
    source.write_text("KINK = 1")
    for change, stays in (("KINK = 1", False), ("KINK = 1", True), ("KINK = 2", False), ("KINK = 2", True)):
        source.write_text(change)
        index.touch()
        compiled._forget_what_is_stale(tmp_path)
        assert index.exists() is stays
