"""The laws of a distribution, each over the list of instances in conftest.py."""

import contextlib
import math
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from scipy import stats
from torch import func
from torch.autograd import gradcheck

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE, huber_energy
from phd_exp.distributions.special import log_normaliser

N_SAMPLES = 100_000


@pytest.fixture(scope="session")
def samples(distribution: ProjectedHuber) -> torch.Tensor:
    torch.manual_seed(3)
    return distribution.sample(torch.Size([N_SAMPLES]))


def test_log_prob_is_the_papers_density(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    """-log p = h(|q|) + a max(t, 1/t) + log K_proj + log K_depth in the camera frame, as printed; q with k."""
    xyz = samples[:500]
    mu_xy, mu_z, A, a = distribution.mu_xy, distribution.mu_z, distribution.A, distribution.a
    z = xyz[:, 2]
    q = ((xyz[:, :2] / z[:, None] - mu_xy) @ A) * (z / mu_z)[:, None]
    t = z / mu_z
    q = q if distribution.k is None else q + distribution.k * (a * (t - 1))[:, None]
    log_K_proj = torch.log(2 * math.pi * (1 + math.exp(-0.5)) * mu_z**2 / torch.linalg.det(A))
    if distribution.rounding:  # an own law of depth, normalised in test_rounded.py
        sinh, r = a * (t - 1 / t) / 2, distribution.rounding
        depth_energy = a * (t + 1 / t) / 2 + (sinh.square() + r**2).sqrt() - a - r
        log_K_depth = torch.log(mu_z) + distribution.depth_law.log_normaliser
    else:
        depth_energy = a * torch.maximum(t, 1 / t)
        log_K_depth = torch.log(mu_z) + log_normaliser(a)
    expected = -(huber_energy(q) + depth_energy + log_K_proj + log_K_depth)
    torch.testing.assert_close(distribution.log_prob(xyz), expected, rtol=1e-8, atol=1e-8)


def test_mean_and_covariance_are_those_of_samples(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    scale = distribution.stddev
    assert ((samples.mean(0) - distribution.mean) / scale).abs().max() < 0.01
    difference = torch.cov(samples.T) - distribution.covariance_matrix
    assert (difference / (scale[:, None] * scale)).abs().max() < 0.02
    torch.testing.assert_close(distribution.covariance_matrix.diagonal(), distribution.variance)
    torch.testing.assert_close(distribution.variance[2], distribution.depth_variance)
    torch.testing.assert_close(distribution.mean[2], distribution.depth_mean)


def test_projection_has_its_mean_and_covariance(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    """E[(x, y)/z] = mu_xy + d (1 - E[1/t]) and Cov = c A^(-2) + Var[1/t] d d^T, where d is 0 without a free axis.

    By E over q and t alone, since (mu_z/z)^2 has heavy tails but mean one.
    """
    A_inverse, k = torch.linalg.inv(distribution.A), distribution.k
    inverse_t = distribution.mu_z / samples[:, 2]
    mean = distribution.mu_xy
    expected = HUBER_COVARIANCE * A_inverse @ A_inverse
    if k is not None:
        d = -A_inverse @ k * distribution.a
        mean = mean + d * (1 - inverse_t.mean())
        expected = expected + d[:, None] * d * inverse_t.var()
    scale = expected.diagonal().sqrt()
    assert ((distribution.projected_mean - mean) / scale).abs().max() < 0.01
    assert ((distribution.projected_covariance - expected) / (scale[:, None] * scale)).abs().max() < 0.02
    offset = samples[:, :2] / samples[:, 2:] - distribution.projected_mean
    near = inverse_t < 50  # what is left out is below 2 % of the covariance
    sampled = (offset[near, :, None] * offset[near, None, :]).sum(0) / N_SAMPLES
    assert ((sampled - expected) / (scale[:, None] * scale)).abs().max() < 0.05


def test_depth_cdf_and_level_of_samples_are_uniform(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    z = samples[:, 2]
    for values in (distribution.depth_cdf(z), distribution.level(samples)):
        assert stats.kstest(values, "uniform").pvalue > 1e-3
    assert (z < distribution.depth_median).double().mean().item() == pytest.approx(0.5, abs=0.005)


def test_level_orders_positions_as_the_density_does(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    xyz = samples[:1000]
    level, order = distribution.level(xyz), distribution.log_prob(xyz).argsort(descending=True)
    assert (level[order].diff() >= -1e-9).all()
    assert distribution.level(distribution.mode) == pytest.approx(0, abs=1e-7)
    assert distribution.level(distribution.mode * 1e6) == pytest.approx(1, abs=1e-12)
    assert distribution.level(-distribution.mode) == 1


def test_mode_is_a_maximum(distribution: ProjectedHuber) -> None:
    generator = torch.Generator().manual_seed(6)
    top = distribution.log_prob(distribution.mode)
    for size in (1e-6, 1e-3, 0.1, 1.0):
        step = size * distribution.stddev * torch.randn(200, 3, generator=generator, dtype=torch.float64)
        assert (distribution.log_prob(distribution.mode + step) <= top).all()


def test_entropy_is_minus_the_mean_log_prob(distribution: ProjectedHuber, samples: torch.Tensor) -> None:
    log_prob = distribution.log_prob(samples)
    standard_error = (log_prob.std() / math.sqrt(N_SAMPLES)).item()
    assert distribution.entropy().item() == pytest.approx(-log_prob.mean().item(), abs=4 * standard_error)


def test_depth_quantiles_end_at_the_camera_and_at_infinity(distribution: ProjectedHuber) -> None:
    p = torch.linspace(0.001, 0.999, 99, dtype=torch.float64)
    torch.testing.assert_close(distribution.depth_cdf(distribution.depth_icdf(p)), p, rtol=1e-8, atol=1e-12)
    assert (distribution.depth_icdf(0.0), distribution.depth_icdf(1.0)) == (0, torch.inf)
    behind = torch.tensor([0.0, -1.0, -torch.inf], dtype=torch.float64)
    assert torch.equal(distribution.depth_cdf(behind), torch.zeros_like(behind))


def test_gradients_of_positions(distribution: ProjectedHuber) -> None:
    scale = 0.3 * distribution.stddev  # offsets in standard deviations, for the step of gradcheck
    offset = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(7))

    def log_prob(offset: torch.Tensor) -> torch.Tensor:
        return distribution.log_prob(distribution.mode + scale * offset)

    assert gradcheck(log_prob, offset.requires_grad_(), rtol=1e-3, atol=1e-4)


def test_a_sample_is_differentiable() -> None:
    """Its moments then have the gradients of the closed forms."""
    raw = torch.tensor([0.4, -0.8, 1.3, 0.7, 2.1, 0.5, -0.9], dtype=torch.float64, requires_grad=True)

    def sample(raw: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(9)
        return ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3).rsample(torch.Size([7]))

    assert gradcheck(sample, raw)


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("sample_shape", [(), (5,), (2, 3)])
def test_shapes_of_a_batch(sample_shape: tuple[int, ...], numbers: int) -> None:
    """A batch of two images with four points each."""
    raw = torch.randn(2, 4, numbers, generator=torch.Generator().manual_seed(10))
    f = torch.tensor([[1200.0], [1800.0]])
    batch = ProjectedHuber.from_raw(raw, f=f, S=224.0, mu_z0=2.5e-3)
    assert batch.batch_shape == (2, 4)
    assert batch.event_shape == (3,)
    xyz = batch.sample(torch.Size(sample_shape))
    assert xyz.shape == (*sample_shape, 2, 4, 3)
    assert batch.log_prob(xyz).shape == batch.level(xyz).shape == (*sample_shape, 2, 4)
    assert batch.mode.shape == batch.mean.shape == batch.variance.shape == (2, 4, 3)
    assert batch.covariance_matrix.shape == (2, 4, 3, 3)
    assert batch.apex.shape == (2, 4, 3)
    assert batch.mu_xy.shape == batch.m_xy.shape == batch.projected_mean.shape == (2, 4, 2)
    assert batch.projected_covariance.shape == batch.A.shape == (2, 4, 2, 2)
    assert batch.entropy().shape == batch.depth_median.shape == batch.log_det_A.shape == (2, 4)
    torch.testing.assert_close(batch.log_det_A, torch.linalg.slogdet(batch.A).logabsdet, rtol=1e-4, atol=1e-4)
    one = ProjectedHuber.from_raw(raw[1, 2], f=1800.0, S=224.0, mu_z0=2.5e-3)
    torch.testing.assert_close(batch.log_prob(xyz)[..., 1, 2], one.log_prob(xyz[..., 1, 2, :]))


VALUES = {
    "log_prob": lambda p, xyz: p.log_prob(xyz),
    "level": lambda p, xyz: p.level(xyz),
    "mode": lambda p, xyz: p.mode,
    "mean": lambda p, xyz: p.mean,
    "covariance": lambda p, xyz: p.covariance_matrix,
    "projected mean": lambda p, xyz: p.projected_mean,
    "projected covariance": lambda p, xyz: p.projected_covariance,
    "entropy": lambda p, xyz: p.entropy(),
    "depth_icdf": lambda p, xyz: p.depth_icdf(0.3),
    "depth_cdf": lambda p, xyz: p.depth_cdf(xyz[..., 2]),
    "depth_crps": lambda p, xyz: p.depth_crps(xyz[..., 2]),
    "samples": lambda p, xyz: p.rsample((3,), torch.Generator().manual_seed(0)),
}


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES.keys())
def test_an_empty_batch_gives_empty_values(
    value: Callable[[ProjectedHuber, torch.Tensor], torch.Tensor], numbers: int
) -> None:
    empty = ProjectedHuber.from_raw(torch.zeros(0, numbers), f=1500.0, S=224.0, mu_z0=2.5e-3)
    one = ProjectedHuber.from_raw(torch.zeros(1, numbers), f=1500.0, S=224.0, mu_z0=2.5e-3)
    shape = value(one, torch.ones(1, 3)).shape
    nothing = value(empty, torch.ones(0, 3))
    assert nothing.shape == torch.Size([0 if size == 1 else size for size in shape])
    again = ProjectedHuber(**empty.parameters)
    assert again.batch_shape == (0,)


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [10.0, 90.0, 1e3, 1e9])
def test_what_passes_validation_gives_finite_values(size: float, dtype: torch.dtype, numbers: int) -> None:
    """Numbers of this size are refused, or every value is finite."""
    signs = torch.randint(-1, 2, (60, numbers), generator=torch.Generator().manual_seed(1))
    passed = []
    for raw in size * signs.to(dtype):
        with contextlib.suppress(ValueError):
            ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3)
            passed.append(raw)
    distribution = ProjectedHuber.from_raw(torch.stack(passed), f=1500.0, S=224.0, mu_z0=2.5e-3)
    xyz = torch.tensor([0.1, -0.2, 4.0], dtype=dtype)
    for name, value in VALUES.items():
        assert value(distribution, xyz).isfinite().all(), name


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # of jacfwd itself
@pytest.mark.parametrize(
    "raw", [torch.zeros(7), torch.zeros(9), torch.tensor([0.4, -0.8, 1.3, 0.7, 2.1, -3.0, -0.9, 0.6, -0.2])]
)
def test_function_transforms_work_through_the_loss(raw: torch.Tensor) -> None:
    """vmap, forward and reverse mode, once and twice; on the seams of the map too. Against plain autograd."""
    xyz = torch.tensor([[0.1, -0.2, 4.0], [0.0, 0.1, 3.0]], dtype=torch.float64)
    raw = raw.double()

    def loss(raw: torch.Tensor, xyz: torch.Tensor) -> torch.Tensor:
        distribution = ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3, validate_args=False)
        return -distribution.log_prob(xyz)

    expected = torch.autograd.functional.jacobian(lambda raw: loss(raw, xyz), raw)
    torch.testing.assert_close(func.vmap(loss, (None, 0))(raw, xyz), loss(raw, xyz))
    for transform in (func.grad, func.jacfwd, func.jacrev):
        torch.testing.assert_close(func.vmap(transform(loss), (None, 0))(raw, xyz), expected)
    curvature = torch.autograd.functional.hessian(lambda raw: loss(raw, xyz).sum(), raw)
    with pytest.raises(NotImplementedError, match=r"use torch\.func\.hessian"):
        func.jacfwd(func.jacfwd(loss))(raw, xyz[0])
    for outer, inner in ((func.jacfwd, func.jacrev), (func.jacrev, func.jacfwd), (func.jacrev, func.jacrev)):
        found = func.vmap(outer(inner(loss)), (None, 0))(raw, xyz)
        torch.testing.assert_close(found.sum(0), curvature)


def test_expand(distribution: ProjectedHuber) -> None:
    larger = distribution.expand((4, 5))
    assert larger.batch_shape == (4, 5)
    assert isinstance(larger, ProjectedHuber)
    assert torch.equal(larger.mode[2, 3], distribution.mode)
    assert larger.sample().shape == (4, 5, 3)
    assert torch.equal(larger.log_prob(larger.mode), distribution.log_prob(distribution.mode).expand(4, 5))
    assert repr(larger) == "ProjectedHuber(batch_shape=(4, 5))"


def test_positions_behind_the_camera_or_at_infinity_have_no_density_and_no_gradient() -> None:
    inf = math.inf
    nowhere = [[0.0, 0.0, -1.0], [0.1, 0.2, 0.0], [0.0, 0.0, inf], [0.1, -inf, 2.0], [inf, inf, inf]]
    xyz = torch.tensor([*nowhere, [0.0, 0.0, 1.0]], requires_grad=True)
    raw = torch.zeros(7, requires_grad=True)
    distribution = ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3)
    log_prob = distribution.log_prob(xyz)
    assert log_prob.tolist()[:-1] == [-inf] * len(nowhere)
    assert distribution.level(xyz).tolist()[:-1] == [1] * len(nowhere)
    log_prob[:-1].sum().backward()
    for gradient in (xyz.grad, raw.grad):
        assert gradient is not None
        assert torch.equal(gradient, torch.zeros_like(gradient))


GOOD = {"mu_xy": torch.zeros(2), "mu_z": torch.tensor(4.0), "A": torch.eye(2), "a": torch.tensor(1.0)}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("mu_xy", torch.tensor([0.0, torch.nan]), r"mu_xy of shape \(2,\) must be finite .* nan"),
        ("mu_z", torch.tensor(-4.0), r"mu_z of shape \(\) must be .*GreaterThan\(lower_bound=0.0\).* -4.0"),
        ("mu_z", torch.tensor([4.0, torch.inf]), r"mu_z of shape \(2,\) must be .* 1 of 2 do not.* inf"),
        ("A", torch.tensor([[1.0, 2.0], [2.0, 1.0]]), r"A of shape \(2, 2\) must be .*PositiveDefinite"),
        ("A", torch.tensor([[1.0, 0.5], [0.0, 1.0]]), r"A of shape \(2, 2\) must be .*PositiveDefinite"),
        ("a", torch.tensor(0.0), r"a of shape \(\) must be .* 0.0"),
        ("k", torch.tensor([0.0, torch.inf]), r"k of shape \(2,\) must be finite .* inf"),
    ],
)
def test_refuses_bad_parameters(name: str, value: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProjectedHuber(**{**GOOD, name: value})
    ProjectedHuber(**{**GOOD, name: value}, validate_args=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"raw": torch.zeros(2, 8)}, r"raw: got shape \(2, 8\); expected 7 as the last dimension, or 9 with k"),
        ({"raw": torch.full((2, 7), torch.nan)}, r"raw of shape \(2, 7\) must be finite"),
        ({"raw": torch.full((7,), 1e30)}, r"raw of shape \(7,\) must be .*upper_bound=1000000000.0"),
        ({"raw": torch.full((7,), -100.0)}, r"covariance of 1 of 1 distributions overflow in torch.float32"),
        ({"f": torch.tensor([1500.0, -1.0])}, r"f of shape \(2,\) must be .* -1.0"),
        ({"f": 0.0}, r"f of shape \(\) must be .* 0.0"),
        ({"S": -224.0}, "S of shape"),
        ({"mu_z0": math.inf}, "mu_z0 of shape"),
    ],
)
def test_refuses_bad_raw_numbers_and_cameras(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProjectedHuber.from_raw(**{"raw": torch.zeros(2, 7), "f": 1500.0, "S": 224.0, "mu_z0": 2.5e-3, **arguments})


def test_refuses_positions_of_a_wrong_shape_or_kind() -> None:
    distribution = ProjectedHuber(**GOOD).expand((4,))
    with pytest.raises(ValueError, match="NaN in 1 of them"):
        distribution.log_prob(torch.tensor([[0.0, 0.0, math.nan], [0.0, 0.0, 4.0]])[:, None])
    with pytest.raises(ValueError, match=r"got batch shape \(3,\); expected one that broadcasts with \(4,\)"):
        distribution.log_prob(torch.zeros(3, 3))


COMPILED = """
import torch
from phd_exp.distributions import ProjectedHuber

def loss(raw):
    distribution = ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3, validate_args=False)
    return -distribution.log_prob(torch.tensor([0.1, -0.2, 4.0])).mean()

raw = torch.randn(8, 7, generator=torch.Generator().manual_seed(0)).requires_grad_()
compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
torch.testing.assert_close(*(torch.autograd.grad(function(raw), raw)[0] for function in (loss, compiled)))
"""


@pytest.mark.slow
def test_the_loss_compiles_in_one_piece() -> None:
    """In another process: the compiler cannot follow the checks of annotations that tests add."""
    subprocess.run([sys.executable, "-c", COMPILED], check=True)
