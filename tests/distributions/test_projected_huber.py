"""The Projected Huber density: the paper's formula, the free axis, what is refused, and function transforms.

The laws that it shares with all densities are in test_laws.py.
"""

import contextlib
import math
import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import func
from torch.autograd import gradcheck

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE, huber_energy
from phd_exp.distributions.special import log_normaliser
from tests.distributions.test_laws import VALUES, N, samples
from tests.support.densities import FREE, INSTANCES, MU_Z0, F, S, parameters

PAPERS = {name: one for name, one in INSTANCES.items() if one.k is None}
every_free_axis = pytest.mark.parametrize("free", FREE.values(), ids=FREE)


@pytest.mark.parametrize("name", INSTANCES)
def test_log_prob_is_the_papers_density(name: str) -> None:
    """-log p = h(|q|) + a max(t, 1/t) + log K_proj + log K_depth in the camera frame, as printed; q with k."""
    distribution, xyz = INSTANCES[name], samples(name)[:500]
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


@pytest.mark.parametrize("name", INSTANCES)
def test_entropy_is_minus_the_mean_log_prob(name: str) -> None:
    log_prob, entropy = INSTANCES[name].log_prob(samples(name)), INSTANCES[name].entropy()
    assert float(entropy) == pytest.approx(-float(log_prob.mean()), abs=4 * float(log_prob.std()) / math.sqrt(N))


@pytest.mark.parametrize("name", INSTANCES)
def test_projected_moments_are_those_of_q_and_t(name: str) -> None:
    """E[(x, y)/z] = mu_xy + d (1 - E[1/t]) and Cov = c A^(-2) + Var[1/t] d d^T, where d is 0 without a free axis."""
    p, inverse_t = INSTANCES[name], INSTANCES[name].mu_z / samples(name)[:, 2]
    A_inverse = torch.linalg.inv(p.A)
    d = torch.zeros(2).double() if p.k is None else -A_inverse @ p.k * p.a
    expected = HUBER_COVARIANCE * A_inverse @ A_inverse + d[:, None] * d * inverse_t.var()
    scale = expected.diagonal().sqrt()
    assert ((p.projected_mean - p.mu_xy - d * (1 - inverse_t.mean())) / scale).abs().max() < 0.015
    assert ((p.projected_covariance - expected) / (scale[:, None] * scale)).abs().max() < 0.03
    torch.testing.assert_close(p.covariance_matrix.diagonal(), p.variance)


@pytest.mark.parametrize("paper", PAPERS.values(), ids=PAPERS)
def test_without_tilt_every_value_is_the_papers_to_the_last_bit(paper: ProjectedHuber) -> None:
    free = ProjectedHuber(**parameters(paper), k=torch.zeros(2, dtype=torch.float64), rounding=paper.rounding)
    paper = ProjectedHuber(**parameters(paper), rounding=paper.rounding)
    xyz = paper.rsample((200,), torch.Generator().manual_seed(0))
    for name, (value, _) in VALUES.items():
        assert torch.equal(value(free, xyz), value(paper, xyz)), name
    again = (one.rsample((9,), torch.Generator().manual_seed(0)) for one in (free, paper))
    assert torch.equal(*again)


@every_free_axis
def test_it_is_the_papers_density_moved_to_the_apex(free: ProjectedHuber) -> None:
    paper = ProjectedHuber(free.m_xy, free.mu_z, free.A, free.a)
    xyz = free.rsample((50,), torch.Generator().manual_seed(3))
    torch.testing.assert_close(free.log_prob(xyz), paper.log_prob(xyz - free.apex))
    again = ProjectedHuber.about_axis(free.m_xy, free.apex[:2], free.mu_z, free.A, free.a)
    for name, value in parameters(free).items():
        torch.testing.assert_close(parameters(again)[name], value)


def test_a_sample_is_differentiable() -> None:
    """Its moments then have the gradients of the closed forms."""
    raw = torch.tensor([0.4, -0.8, 1.3, 0.7, 2.1, 0.5, -0.9], dtype=torch.float64, requires_grad=True)

    def sample(raw: torch.Tensor) -> torch.Tensor:
        torch.manual_seed(9)
        return ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0).rsample(torch.Size([7]))

    assert gradcheck(sample, raw)


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [10.0, 90.0, 1e3, 1e9])
def test_what_passes_validation_gives_finite_values(size: float, dtype: torch.dtype, numbers: int) -> None:
    """Numbers of this size are refused, or every value is finite."""
    signs = torch.randint(-1, 2, (60, numbers), generator=torch.Generator().manual_seed(1))
    passed = []
    for raw in size * signs.to(dtype):
        with contextlib.suppress(ValueError):
            ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0)
            passed.append(raw)
    distribution = ProjectedHuber.from_raw(torch.stack(passed), f=F, S=S, mu_z0=MU_Z0)
    xyz = torch.tensor([0.1, -0.2, 4.0], dtype=dtype)
    for name, (value, _) in VALUES.items():
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
        distribution = ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0, validate_args=False)
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
    distribution = ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0)
    log_prob = distribution.log_prob(xyz)
    assert log_prob.tolist()[:-1] == [-inf] * len(nowhere)
    assert distribution.level(xyz).tolist()[:-1] == [1] * len(nowhere)
    log_prob[:-1].sum().backward()
    for gradient in (xyz.grad, raw.grad):
        assert gradient is not None
        assert torch.equal(gradient, torch.zeros_like(gradient))


GOOD = {"mu_xy": torch.zeros(2), "mu_z": torch.tensor(4.0), "A": torch.eye(2), "a": torch.tensor(1.0)}
RAW = {"raw": torch.zeros(2, 7), "f": 1500.0, "S": 224.0, "mu_z0": 2.5e-3}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mu_xy": torch.tensor([0.0, torch.nan])}, r"mu_xy of shape \(2,\) must be finite .* nan"),
        ({"mu_z": torch.tensor(-4.0)}, r"mu_z of shape \(\) must be .*GreaterThan\(lower_bound=0.0\).* -4.0"),
        ({"mu_z": torch.tensor([4.0, torch.inf])}, r"mu_z of shape \(2,\) must be .* 1 of 2 do not.* inf"),
        ({"A": torch.tensor([[1.0, 2.0], [2.0, 1.0]])}, r"A of shape \(2, 2\) must be .*PositiveDefinite"),
        ({"A": torch.tensor([[1.0, 0.5], [0.0, 1.0]])}, r"A of shape \(2, 2\) must be .*PositiveDefinite"),
        ({"a": torch.tensor(0.0)}, r"a of shape \(\) must be .* 0.0"),
        ({"k": torch.tensor([0.0, torch.inf])}, r"k of shape \(2,\) must be finite .* inf"),
        ({"rounding": -1.0}, "rounding: got -1.0; expected a finite number of at least 0"),
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
def test_refuses_bad_parameters_raw_numbers_and_cameras(wrong: dict[str, Any], message: str) -> None:
    make, good = (ProjectedHuber.from_raw, RAW) if wrong.keys() & RAW.keys() else (ProjectedHuber, GOOD)
    with pytest.raises(ValueError, match=message):
        make(**{**good, **wrong})
    if wrong.keys() & GOOD.keys():
        ProjectedHuber(**{**GOOD, **wrong}, validate_args=False)


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
