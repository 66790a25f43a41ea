"""The laws of every density other than the paper's, each over vague, generic and sharp raw numbers, in float64."""

from itertools import chain

import numpy as np
import pytest
import torch
from scipy import stats

from phd_exp.distributions import Density, ProjectedHuber
from phd_exp.distributions.laws import StudentLaw
from phd_exp.distributions.shaped import Shaped, StudentT
from phd_exp.geometry import Camera
from phd_exp.geometry.charts import projected
from tests.support.heads import SHAPED

CAMERA = Camera(torch.tensor(1550.0, dtype=torch.float64), 224.0)
FURTHER = [0.4, -0.7, 2.0]
SEVEN = {
    "untrained": [0.0] * 7,
    "generic": [0.4, -0.8, 1.3, 0.7, 2.1, 7.0, -0.9],
    "trained": [20.0, -45.0, 90.0, 15.0, 120.0, 200.0, 4.0],
}
IN_SPACE = ("gaussian", "gaussian_mixture", "student_t")
N = 50_000


def density(model: str, seven: str, dtype: torch.dtype = torch.float64) -> Density:
    head = SHAPED[model]
    raw = (SEVEN[seven] + (FURTHER if seven != "untrained" else [0.0] * 3))[: head.n_outputs]
    if model == "gaussian_mixture":
        one, other = [0.3, 0.2, -0.2, 0.1, 0.3, -0.4, 0.2, 0.1, 0.0], [-0.5, 0.3, 0.4, 0.0, 0.2, 0.6, -0.3, 0.0, 0.3]
        nine = SEVEN[seven] + (FURTHER[:2] if seven != "untrained" else [0.0] * 2)
        parts = ([a + b for a, b in zip(nine, apart, strict=True)] for apart in ([0.0] * 9, one, other))
        raw = [*chain.from_iterable(parts), 0.2, -0.3, 0.0]
    return head(torch.tensor(raw, dtype=dtype), Camera(CAMERA.f.to(dtype), CAMERA.S))


@pytest.fixture(scope="module", params=[(m, s) for m in SHAPED for s in SEVEN], ids=" ".join)
def case(request: pytest.FixtureRequest) -> tuple[str, str, Density, torch.Tensor]:
    law = density(*request.param)
    return (*request.param, law, law.rsample((N,), torch.Generator().manual_seed(1)))


def test_integrates_to_one(case: tuple) -> None:
    """By trapezoids in the sinh of coordinates along the axes of the samples: any tail is reached."""
    _, seven, law, _ = case
    if seven == "untrained":
        pytest.skip("its cone about the camera is no ellipsoid: the levels of samples and the importance test below")
    axes = torch.linalg.cholesky(law.covariance_matrix)
    y = torch.linspace(-6, 6, 97, dtype=torch.float64)
    total, step = 0.0, float(y[1] - y[0])
    for first in y:
        grid = torch.cartesian_prod(first[None], y, y)
        xyz = law.mode + grid.sinh() @ axes.T / 4
        weight = grid.cosh().prod(-1) * (step / 4) ** 3 * axes.diagonal().prod()
        total += float((law.log_prob(xyz).exp() * weight).sum())
    assert total == pytest.approx(1, abs=5e-3)


def test_has_the_mass_of_its_samples(case: tuple) -> None:
    """The mean of p'/p over samples of p is 1, here for a narrow p' about the mode."""
    _, _, law, samples = case
    middle = ((samples[:, 2] / law.mode[2]).log().abs() < 0.2) & (law.level(samples) < 0.8)
    near = samples[middle]
    narrow = torch.distributions.MultivariateNormal(law.mode, near.T.cov() / 6)
    ratio = (narrow.log_prob(samples) - law.log_prob(samples)).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=5 * float(ratio.std()) / N**0.5)
    assert float(ratio.std()) < 10


def test_levels_and_depths_of_own_samples_are_uniform(case: tuple) -> None:
    model, _, law, samples = case
    if model == "gaussian_mixture":  # its levels are sampled
        samples = samples[:2000]
        assert stats.kstest(law.level(samples), "uniform").pvalue > 1e-3
        assert stats.kstest(law.depth_cdf(samples[:, 2]), "uniform").pvalue > 1e-3
        return
    for values in (law.level(samples), law.depth_cdf(samples[:, 2])):
        assert stats.kstest(values, "uniform").pvalue > 1e-3
    p = torch.tensor([1e-4, 0.1, 0.5, 0.8, 0.9999], dtype=torch.float64)
    torch.testing.assert_close(law.depth_cdf(law.depth_icdf(p)), p)
    assert law.depth_median == law.depth_icdf(0.5)


def test_level_is_zero_at_the_mode_and_one_far_away(case: tuple) -> None:
    model, _, law, samples = case
    assert law.level(law.mode) == pytest.approx(0, abs=1e-9)
    aside = torch.tensor([1e9, 0.0, 0.0], dtype=torch.float64)
    assert law.level(law.mode + aside) == pytest.approx(1, abs=1e-6)
    if model not in IN_SPACE:
        assert law.level(-law.mode) == 1
        assert law.log_prob(-law.mode) == law.depth_cdf(-law.mode[2]).log() == -torch.inf
        assert (samples[:, 2] > 0).all()


def test_moments_are_those_of_samples(case: tuple) -> None:
    """Where they exist; those of a linearisation where the density is narrow."""
    model, seven, law, samples = case
    scale = law.covariance_matrix.diagonal().sqrt()
    tolerance = 0.15 if seven == "untrained" else 0.05  # the tails of log z are long
    assert ((samples.mean(0) - law.mean) / scale).abs().max() < tolerance
    assert ((samples.T.cov() - law.covariance_matrix) / (scale[:, None] * scale)).abs().max() < 2 * tolerance
    torch.testing.assert_close(law.covariance_matrix[2, 2], law.depth_variance, rtol=1e-6, atol=0)
    if model not in IN_SPACE or seven == "trained":
        rays = samples[:, :2] / samples[:, 2:]
        error = (rays.T.cov() - law.projected_covariance) / law.projected_covariance.diagonal().max()
        assert error.abs().max() < 0.05
        assert ((rays.mean(0) - law.mu_xy) / rays.std(0)).abs().max() < 0.03


def test_score_of_depth_is_that_of_samples_and_its_slope_that_of_the_definition(case: tuple) -> None:
    _, seven, law, samples = case
    for p in (0.02, 0.5, 0.9):
        z = law.depth_icdf(p)
        step = 1e-3 * (law.depth_icdf(0.75) - law.depth_icdf(0.25))
        slope = (law.depth_crps(z + step) - law.depth_crps(z - step)) / (2 * step)
        assert float(slope) == pytest.approx(2 * p - 1, abs=0.02)
    drawn = samples[:, 2].sort().values
    rank = torch.arange(1, N + 1, dtype=torch.float64)
    half_difference = ((2 * rank - N - 1) * drawn).sum() / N**2
    z = law.depth_icdf(0.3)
    expected = (drawn - z).abs().mean() - half_difference
    assert float(law.depth_crps(z)) == pytest.approx(float(expected), rel=0.05 if seven == "untrained" else 0.02)


@pytest.mark.parametrize("seven", SEVEN)
def test_scores_and_densities_are_those_of_scipy(seven: str) -> None:
    laws = {name: density(name, seven) for name in SHAPED}
    gaussian, t = laws["gaussian"], laws["student_t"]
    huber = gaussian.whitening.around
    xyz = huber.rsample((50,), torch.Generator().manual_seed(2))
    z, mu_z, a = xyz[:, 2], float(huber.mu_z), float(huber.a)
    assert isinstance(t.law, StudentLaw)
    n, covariance = float(t.law.freedom), t.covariance_matrix.numpy()
    theirs = {
        "gaussian": stats.multivariate_normal(gaussian.mode, gaussian.covariance_matrix).logpdf(xyz),
        "student_t": stats.multivariate_t(t.mode, covariance * (n - 2) / n, n).logpdf(xyz),
    }
    mixture = laws["gaussian_mixture"]
    parts = zip(mixture.parts.mode, mixture.parts.covariance_matrix, mixture.log_weight.softmax(-1), strict=True)
    theirs["gaussian_mixture"] = np.log(sum(w * stats.multivariate_normal(m, C).pdf(xyz) for m, C, w in parts))
    for name, expected in theirs.items():
        np.testing.assert_allclose(laws[name].log_prob(xyz), expected, rtol=1e-8, atol=1e-7, err_msg=name)
    decomposed = laws["decomposed"]
    for score in ("depth_cdf", "depth_crps"):
        ours, exact = (getattr(law, score)(z) for law in (decomposed, decomposed.whitening.around))
        torch.testing.assert_close(ours, exact, rtol=1e-3, atol=1e-9)
    w = (z - mu_z) * a / mu_z  # the score of a normal law
    normal = torch.distributions.Normal(0.0, 1.0)
    exact = mu_z / a * (w * (2 * normal.cdf(w) - 1) + 2 * normal.log_prob(w).exp() - np.pi**-0.5)
    torch.testing.assert_close(gaussian.depth_crps(z), exact, rtol=1e-3, atol=1e-9)


def test_many_degrees_of_freedom_are_a_gaussian() -> None:
    gaussian = density("gaussian", "trained")
    law = gaussian.whitening.around
    seven = ProjectedHuber(law.mu_xy, law.mu_z, law.A, law.a)
    many = StudentT(seven, torch.cat([law.k, torch.tensor([1e7])]))
    xyz = gaussian.rsample((100,), torch.Generator().manual_seed(0))
    torch.testing.assert_close(many.log_prob(xyz), gaussian.log_prob(xyz), rtol=0, atol=1e-4)
    torch.testing.assert_close(many.level(xyz), gaussian.level(xyz), rtol=0, atol=1e-5)


@pytest.mark.parametrize("model", SHAPED)
def test_an_untrained_network_is_vague_about_the_middle_and_its_gradients_are_finite(model: str) -> None:
    raw = torch.zeros(8, SHAPED[model].n_outputs, requires_grad=True)
    f = torch.full((8,), 1550.0)
    law = SHAPED[model](raw, Camera(f, 224.0))
    assert (law.mode[:, 2] > 3).all()
    assert (law.mode[:, 2] < 5).all()
    assert (law.depth_icdf(0.9) - law.depth_icdf(0.1) > 1).all()
    xyz = torch.cat([torch.randn(8, 2) / 5, 3 + 2 * torch.rand(8, 1)], dim=-1)
    for positions in (xyz, law.mode.detach()):
        (gradient,) = torch.autograd.grad(law.log_prob(positions).sum(), raw, retain_graph=True)
        assert gradient.isfinite().all()


@pytest.mark.parametrize("model", SHAPED)
def test_placed_shifts_the_projection_of_the_whole_density(model: str) -> None:
    """The density at a position is that at the position whose v_p is moved back by `place`, at the same depth."""
    head, place = SHAPED[model], torch.tensor([0.3, -0.2], dtype=torch.float64)
    raw = torch.randn(20, head.n_outputs, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    camera = Camera(torch.full((20,), 1550.0, dtype=torch.float64), 224.0)
    xyz = torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 1
    moved = xyz + torch.nn.functional.pad(place * 224 / (2 * 1550) * xyz[:, 2:], (0, 1))
    torch.testing.assert_close(projected(moved, camera) - projected(xyz, camera), place.expand(20, 2))
    before, after = head(raw, camera), head(head.placed(raw, place.expand(20, 2)), camera)
    torch.testing.assert_close(after.log_prob(moved), before.log_prob(xyz))


@pytest.mark.parametrize("seven", SEVEN)
@pytest.mark.parametrize("model", SHAPED)
def test_float32_is_near_float64(model: str, seven: str) -> None:
    law = density(model, seven)
    xyz = law.rsample((100,), torch.Generator().manual_seed(0))
    single = density(model, seven, torch.float32)
    assert single.log_prob(xyz.float()).dtype == torch.float32
    for name in ("log_prob", "level"):
        ours, exact = (getattr(one, name)(xyz.to(one.mode.dtype)).double() for one in (single, law))
        torch.testing.assert_close(ours, exact, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(single.covariance_matrix.double(), law.covariance_matrix, rtol=1e-3, atol=1e-6)


def test_a_density_of_another_shape_is_another_law() -> None:
    with pytest.raises(TypeError, match="Mine: Shaped is final; derive from Law"):
        type("Mine", (Shaped,), {})
