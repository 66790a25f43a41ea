"""The laws of every density, over one list of them, in float64."""

from functools import cache

import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.autograd import gradcheck

from phd_exp.distributions import Density, Mixture
from phd_exp.geometry import Camera
from phd_exp.geometry.charts import projected
from tests.support.densities import HEADS, HUBERS, INSTANCES, MIXTURES, OTHERS, SHAPED, raw_numbers, shaped

N = 50_000
EVERY: dict[str, Density | Mixture] = {**INSTANCES, **OTHERS, **MIXTURES}
DENSITIES = {**INSTANCES, **OTHERS}
PROBABILITIES = torch.tensor([1e-4, 0.1, 0.5, 0.8, 0.9999], dtype=torch.float64)
MODELS = (*HUBERS, *SHAPED)


@cache
def samples(name: str) -> Tensor:
    return EVERY[name].rsample((N // 5 if name in MIXTURES else N,), torch.Generator().manual_seed(1))


def is_in_space(name: str) -> bool:
    """Whether positions behind the camera have their share of the density."""
    return name.split(",")[0] in ("gaussian", "gaussian_mixture", "student_t")


def is_vague(name: str) -> bool:
    """Whether the tails of depth are so long that few samples dominate moments."""
    return name.endswith(", untrained") or "wide in depth" in name or name == "vague raw"


def few_rays(name: str) -> bool:
    """Whether (x, y)/z has no moments, or they are those of a linearisation."""
    return (is_in_space(name) and not name.endswith(", trained")) or name in MIXTURES


@pytest.mark.parametrize("name", [name for name in OTHERS if not name.endswith("untrained")])
def test_it_integrates_to_one(name: str) -> None:
    """By trapezoids in the sinh of coordinates along the axes of the samples: any tail is reached."""
    law = OTHERS[name]
    axes, y = torch.linalg.cholesky(law.covariance_matrix), torch.linspace(-6, 6, 73, dtype=torch.float64)
    total, step = 0.0, float(y[1] - y[0])
    for first in y:
        grid = torch.cartesian_prod(first[None], y, y)
        weight = grid.cosh().prod(-1) * (step / 4) ** 3 * axes.diagonal().prod()
        total += float((law.log_prob(law.mode + grid.sinh() @ axes.T / 4).exp() * weight).sum())
    assert total == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("name", DENSITIES)
def test_it_has_the_mass_of_its_samples(name: str) -> None:
    """The mean of p'/p over samples of p is 1, here for a narrow p' about the mode."""
    law, drawn = DENSITIES[name], samples(name)
    near = drawn[((drawn[:, 2] / law.mode[2]).log().abs() < 0.2) & (law.level(drawn) < 0.8)]
    narrow = torch.distributions.MultivariateNormal(law.mode, near.T.cov() / 6)
    ratio = (narrow.log_prob(drawn) - law.log_prob(drawn)).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=5 * float(ratio.std()) / N**0.5)
    assert float(ratio.std()) < 10


@pytest.mark.parametrize("name", EVERY)
def test_levels_and_depths_of_its_samples_are_uniform(name: str) -> None:
    law, drawn = EVERY[name], samples(name)
    by_draws = name in MIXTURES or "mixture" in name
    assert stats.kstest(law.depth_cdf(drawn[:, 2]), "uniform").pvalue > 1e-3
    if name in MIXTURES and "rounded" in name:
        return  # their levels take a minute
    if name in MIXTURES:
        drawn, law = drawn[:60], Mixture(law.members.expand((60, *law.members.batch_shape)))
    levels = law.level(drawn[:2000] if by_draws else drawn)
    assert stats.kstest(levels, "uniform").pvalue > 1e-3
    assert torch.equal(levels, law.level(drawn[:2000] if by_draws else drawn)), "the same draws"


@pytest.mark.parametrize("name", EVERY)
def test_quantiles_of_depth_invert_its_distribution_function(name: str) -> None:
    law = EVERY[name]
    torch.testing.assert_close(law.depth_cdf(law.depth_icdf(PROBABILITIES)), PROBABILITIES, rtol=1e-8, atol=1e-12)
    if name in DENSITIES:
        assert law.depth_median == law.depth_icdf(0.5)
    if name in INSTANCES:
        assert (law.depth_icdf(0.0), law.depth_icdf(1.0)) == (0, torch.inf)


@pytest.mark.parametrize("name", DENSITIES)
def test_the_mode_is_a_maximum_of_level_0_and_levels_grow_as_the_density_falls(name: str) -> None:
    law, drawn = DENSITIES[name], samples(name)[:1000]
    assert law.level(law.mode) == pytest.approx(0, abs=1e-7)
    assert law.level(law.mode + torch.tensor([1e9, 0.0, 0.0])) == pytest.approx(1, abs=1e-6)
    if "decomposed" in name:  # its levels are those of the ray and of depth
        return
    tops, noise = law.log_prob(law.mode), torch.randn(200, 3, generator=torch.Generator().manual_seed(6))
    for size in (1e-6, 1e-3, 0.1, 1.0):
        step = size * law.covariance_matrix.diagonal().sqrt() * noise
        assert (law.log_prob(law.mode + step) <= tops + 1e-12).all()
    assert (law.level(drawn)[law.log_prob(drawn).argsort(descending=True)].diff() >= -1e-9).all()


@pytest.mark.parametrize("name", [name for name in EVERY if not is_in_space(name)])
def test_behind_the_camera_there_is_nothing(name: str) -> None:
    law, behind = EVERY[name], torch.tensor([0.1, -0.2, -3.0], dtype=torch.float64)
    assert (float(law.log_prob(behind)), float(law.level(behind))) == (-torch.inf, 1)
    assert law.depth_cdf(torch.tensor([-3.0, 0.0, -torch.inf], dtype=torch.float64)).tolist() == [0, 0, 0]
    assert (samples(name)[:, 2] > 0).all()


@pytest.mark.parametrize("name", EVERY)
def test_moments_are_those_of_samples(name: str) -> None:
    """Those of (x, y)/z but for the few samples of t < 1/50, whose share is below 2 %."""
    law, drawn, tolerance = EVERY[name], samples(name), 0.15 if is_vague(name) or name in MIXTURES else 0.025
    scale = law.covariance_matrix.diagonal().sqrt()
    assert ((drawn.mean(0) - law.mean) / scale).abs().max() < tolerance
    assert ((drawn.T.cov() - law.covariance_matrix) / (scale[:, None] * scale)).abs().max() < 3 * tolerance
    if name in DENSITIES:
        torch.testing.assert_close(law.covariance_matrix[2, 2], law.depth_variance, rtol=1e-6, atol=0)
        torch.testing.assert_close(law.mean[2], law.depth_mean)
    if not few_rays(name):
        near, expected = drawn[drawn[:, 2] > law.mode[2] / 50], law.projected_covariance
        off = near[:, :2] / near[:, 2:] - law.projected_mean
        scale = expected.diagonal().sqrt()
        assert ((off.T @ off / len(drawn) - expected) / (scale[:, None] * scale)).abs().max() < (
            0.1 if is_vague(name) else 0.05
        )
        assert (off.mean(0) / off.std(0)).abs().max() < 0.03


@pytest.mark.parametrize("name", DENSITIES)
def test_score_of_depth_is_that_of_samples_and_its_slope_that_of_the_definition(name: str) -> None:
    """E|Z - z| - E|Z - Z'|/2, and 2 F(z) - 1."""
    law, drawn = DENSITIES[name], samples(name)[:, 2].sort().values
    rank = torch.arange(1, N + 1, dtype=torch.float64)
    half_difference = ((2 * rank - N - 1) * drawn).sum() / N**2  # of all pairs, sorted
    z = law.depth_icdf(torch.tensor([0.02, 0.5, 0.9], dtype=torch.float64))
    expected = (drawn[:, None] - z).abs().mean(0) - half_difference
    torch.testing.assert_close(law.depth_crps(z), expected, rtol=0.05 if is_vague(name) else 0.02, atol=0)
    step = 1e-3 * (law.depth_icdf(0.75) - law.depth_icdf(0.25))
    slope = (law.depth_crps(z + step) - law.depth_crps(z - step)) / (2 * step)
    torch.testing.assert_close(slope, 2 * law.depth_cdf(z) - 1, rtol=0, atol=2e-2 if name in OTHERS else 1e-5)


@pytest.mark.parametrize("name", DENSITIES)
def test_its_gradients_are_true(name: str) -> None:
    """In standard deviations, for the step of gradcheck."""
    law, noise = DENSITIES[name], torch.randn(5, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    scale = 0.3 * law.covariance_matrix.diagonal().sqrt()
    scale = scale.minimum(law.mode[2] / 8)  # in front of the camera
    assert gradcheck(lambda x: law.log_prob(law.mode + scale * x), noise.requires_grad_(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("place", ["untrained", "generic", "trained"])
@pytest.mark.parametrize("model", MODELS)
def test_float32_is_near_float64(model: str, place: str) -> None:
    exact, single = shaped(model, place), shaped(model, place, torch.float32)
    xyz = exact.rsample((100,), torch.Generator().manual_seed(0))
    assert single.log_prob(xyz.float()).dtype == torch.float32
    for name in ("log_prob", "level"):
        ours, expected = (getattr(one, name)(xyz.to(one.mode.dtype)).double() for one in (single, exact))
        torch.testing.assert_close(ours, expected, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(single.covariance_matrix.double(), exact.covariance_matrix, rtol=1e-3, atol=1e-6)


VALUES = {
    "log_prob": (lambda p, xyz: p.log_prob(xyz), 0),
    "level": (lambda p, xyz: p.level(xyz), 0),
    "mode": (lambda p, xyz: p.mode, 1),
    "mean": (lambda p, xyz: p.mean, 1),
    "covariance": (lambda p, xyz: p.covariance_matrix, 2),
    "projected mean": (lambda p, xyz: p.projected_mean, 1),
    "projected covariance": (lambda p, xyz: p.projected_covariance, 2),
    "depth_icdf": (lambda p, xyz: p.depth_icdf(0.3), 0),
    "depth_cdf": (lambda p, xyz: p.depth_cdf(xyz[..., 2]), 0),
    "depth_crps": (lambda p, xyz: p.depth_crps(xyz[..., 2]), 0),
}
"""Name -> a value of a density at positions, and the number of its dimensions."""


@pytest.mark.parametrize("model", MODELS)
def test_a_batch_is_its_rows(model: str) -> None:
    """Of two cameras with four points each, several samples at a time, or none."""
    raw = raw_numbers(model, 8, torch.Generator().manual_seed(10)).unflatten(0, (2, 4))
    f = torch.tensor([[1200.0], [1800.0]], dtype=torch.float64)
    batch, one = HEADS[model](raw, Camera(f, 224.0)), HEADS[model](raw[1, 2], Camera(f[1, 0], 224.0))
    empty = HEADS[model](raw[:0, 0], Camera(f[:0, 0], 224.0))
    for shape in ((), (5,), (2, 3)):
        xyz = batch.rsample(shape, torch.Generator().manual_seed(0))
        assert xyz.shape == (*shape, 2, 4, 3)
        for name, (value, event) in VALUES.items():
            row = value(batch, xyz)[(..., 1, 2, *[slice(None)] * event)]
            torch.testing.assert_close(row, value(one, xyz[..., 1, 2, :]), rtol=1e-6, atol=1e-9, msg=name)
    for name, (value, _) in VALUES.items():
        assert value(empty, torch.zeros(0, 3).double()).shape[0] == 0, name


@pytest.mark.parametrize("model", MODELS)
def test_an_untrained_network_is_vague_about_the_middle_and_every_output_learns(model: str) -> None:
    raw = torch.zeros(8, HEADS[model].n_outputs, requires_grad=True)
    law = HEADS[model](raw, Camera(torch.full((8,), 1550.0), 224.0))
    assert ((law.mode[:, 2] > 3) & (law.mode[:, 2] < 5) & (law.depth_icdf(0.9) - law.depth_icdf(0.1) > 1)).all()
    xyz = torch.cat([torch.randn(8, 2) / 5, 3 + 2 * torch.rand(8, 1)], dim=-1)
    for positions in (xyz, law.mode.detach()):
        (gradient,) = torch.autograd.grad(law.log_prob(positions).sum(), raw, retain_graph=True)
        assert gradient.isfinite().all()
    if model != "rounded_t":  # trained through its surrogate
        (gradient,) = torch.autograd.grad(law.log_prob(xyz).sum(), raw)
        assert (gradient.abs() > 1e-5).any(0).all()


@pytest.mark.parametrize("model", MODELS)
def test_placed_shifts_the_projection_of_the_whole_density(model: str) -> None:
    """The density at a position is that at the position whose v_p is moved back by `place`, at the same depth."""
    random, place = torch.Generator().manual_seed(0), torch.tensor([0.3, -0.2], dtype=torch.float64)
    raw = torch.randn(20, HEADS[model].n_outputs, generator=random, dtype=torch.float64)
    camera, xyz = Camera(torch.full((20,), 1550.0).double(), 224.0), torch.rand(20, 3, generator=random).double() + 1
    moved = xyz + torch.nn.functional.pad(place * 224 / (2 * 1550) * xyz[:, 2:], (0, 1))
    torch.testing.assert_close(projected(moved, camera) - projected(xyz, camera), place.expand(20, 2))
    before, after = (HEADS[model](one, camera) for one in (raw, HEADS[model].placed(raw, place.expand(20, 2))))
    torch.testing.assert_close(after.log_prob(moved), before.log_prob(xyz))
