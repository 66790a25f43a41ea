"""From seven raw numbers to a loss: printed formulas, seams, extremes, convexity and bounded gradients."""

import itertools
import math

import pytest
import torch
from torch.autograd import gradcheck

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import huber_energy
from phd_exp.distributions.special import log_normaliser
from phd_exp.geometry import Camera, compensated_depth, projected
from tests.support.densities import MU_Z0, F, S

XYZ = torch.tensor([[0.12, -0.2, 3.1], [-0.25, 0.1, 4.9], [0.05, 0.02, 3.75]], dtype=torch.float64)
GENERIC = [0.4, -0.8, 1.3, 0.7, 2.1, 3.0, -0.9]


def loss(raw: torch.Tensor, xyz: torch.Tensor, f: float = F) -> torch.Tensor:
    """-log p without its constants, so that it is the paper's L: of order one for an untrained network."""
    constants = math.log(2 * math.pi * (1 + math.exp(-0.5))) + 2 * math.log(S * MU_Z0 / 2) + math.log(MU_Z0 * f)
    distribution = ProjectedHuber.from_raw(raw, f=f, S=S, mu_z0=MU_Z0, validate_args=False)  # as in training
    return -distribution.log_prob(xyz) - constants


def printed_parameters(raw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """nu_p, B, a and nu_z of seven raw numbers, as printed in the paper, with the eigenvalues of B bounded."""
    nu_p, (b_1, b_2, b_3), (w_1, w_2) = raw[:2], raw[2:5], raw[5:]
    off = b_2 / math.sqrt(2)
    s, U = torch.linalg.eigh(torch.stack([torch.stack([b_1, off]), torch.stack([off, b_3])]))
    eigenvalues = torch.where(s >= 0, s + 1, s.exp())
    B = U @ torch.diag(eigenvalues.clamp_min(eigenvalues[1] / 100)) @ U.T  # the bound is not in the paper
    a = w_1 + 1 if w_1 >= 0 else w_1.exp()
    nu_z = 1 + w_2 / a if w_2 > 0 else 1 / (1 - w_2 / a)
    return nu_p, B, a, nu_z


def printed_loss(raw: torch.Tensor, xyz: torch.Tensor) -> torch.Tensor:
    """L = h(|B v_p - nu_p| z_p) - log|B| + a max(z_p/nu_z, nu_z/z_p) + log N(a) + log nu_z; of nine with k."""
    nu_p, B, a, nu_z = printed_parameters(raw[:7])
    camera = Camera(torch.tensor(F, dtype=torch.float64), S)
    v_p, z_p = projected(xyz, camera), compensated_depth(xyz, camera, MU_Z0)
    q = (v_p @ B - nu_p) * z_p[:, None]
    q = q + raw[7:] * (a * (z_p / nu_z - 1))[:, None] if len(raw) > 7 else q
    projection = huber_energy(q) - torch.logdet(B)
    return projection + a * torch.maximum(z_p / nu_z, nu_z / z_p) + log_normaliser(a) + nu_z.log()


def raw_numbers(n: int, scale: float, seed: int, numbers: int = 7) -> torch.Tensor:
    return scale * torch.randn(n, numbers, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("scale", [0.3, 1.0, 5.0])
def test_loss_is_the_printed_formula(scale: float, numbers: int) -> None:
    for raw in raw_numbers(30, scale, 0, numbers):
        torch.testing.assert_close(loss(raw, XYZ), printed_loss(raw, XYZ))


def test_camera_frame_parameters_are_the_printed_ones() -> None:
    for raw in raw_numbers(30, 1.0, seed=1):
        nu_p, B, a, nu_z = printed_parameters(raw)
        distribution = ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0)
        torch.testing.assert_close(distribution.mu_z, nu_z * MU_Z0 * F)
        torch.testing.assert_close(distribution.A, 2 * F * nu_z / S * B)
        torch.testing.assert_close(distribution.mu_xy, S / (2 * F) * torch.linalg.solve(B, nu_p))
        torch.testing.assert_close(distribution.a, a)


n_1, n_2, b_1, b_2, b_3, w_1, w_2 = GENERIC
SEAMS = {
    "generic": GENERIC,
    "zero": [0.0] * 7,
    "equal eigenvalues": [n_1, n_2, 1.3, 0.0, 1.3, w_1, w_2],
    "equal negative eigenvalues": [n_1, n_2, -0.7, 0.0, -0.7, w_1, w_2],
    "an eigenvalue of zero": [n_1, n_2, 1.0, math.sqrt(2), 1.0, w_1, w_2],
    "both eigenvalues zero": [n_1, n_2, 0.0, 0.0, 0.0, w_1, w_2],
    "w_1 = 0": [n_1, n_2, b_1, b_2, b_3, 0.0, w_2],
    "w_2 = 0": [n_1, n_2, b_1, b_2, b_3, w_1, 0.0],
    "w_1 = w_2 = 0": [n_1, n_2, b_1, b_2, b_3, 0.0, 0.0],
    "w_2 = 0, a < 1": [n_1, n_2, b_1, b_2, b_3, -1.0, 0.0],
    "nine": [*GENERIC, 0.7, -0.4],
    "nine zeros": [0.0] * 9,
    "w_1 = w_2 = 0 of nine": [n_1, n_2, b_1, b_2, b_3, 0.0, 0.0, 0.7, -0.4],
}


@pytest.mark.parametrize("raw", SEAMS.values(), ids=SEAMS.keys())
def test_gradients_are_true_on_every_seam(raw: list[float]) -> None:
    # z_p of the last position is 1, where |log t| has a kink for nu_z = 1; the others are away from it
    tensor = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda raw: loss(raw, XYZ[:2]), tensor, atol=2e-6)


EXTREMES = torch.tensor(list(itertools.product((-1e4, 0.0, 1e4), repeat=7)))


@pytest.mark.parametrize("numbers", [7, 9])
@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_float32_is_near_float64(scale: float, numbers: int) -> None:
    raw = raw_numbers(300, scale, 2, numbers).requires_grad_()
    low = raw.detach().float().requires_grad_()
    for xyz in XYZ:
        exact, near = loss(raw, xyz), loss(low, xyz.float())
        torch.testing.assert_close(near.double(), exact, rtol=2e-5, atol=2e-5)
        (slope,) = torch.autograd.grad(exact.sum(), raw)
        (near_slope,) = torch.autograd.grad(near.sum(), low)
        torch.testing.assert_close(near_slope.double(), slope, rtol=1e-3, atol=1e-4)


def of_any_size(n: int, equal_eigenvalues: bool, numbers: int = 7) -> torch.Tensor:
    """Raw numbers of any sign from 1e-4 to 1e4, in float32, as the network's last layer gives them."""
    random = torch.Generator().manual_seed(12)
    size = 10 ** (8 * torch.rand(n, numbers, generator=random) - 4)
    raw = size * torch.randn(n, numbers, generator=random).sign()
    if equal_eigenvalues:
        raw[:, 3], raw[:, 4] = 0, raw[:, 2]
    return raw


@pytest.mark.parametrize(
    "raw",
    [
        EXTREMES,
        1e5 * EXTREMES,
        of_any_size(2000, equal_eigenvalues=False),
        of_any_size(2000, equal_eigenvalues=True),
        of_any_size(2000, equal_eigenvalues=True, numbers=9),
        torch.cat([1e5 * EXTREMES, -1e9 + 2e9 * torch.rand(len(EXTREMES), 2)], dim=-1),
    ],
    ids=["extremes", "further extremes", "any size", "equal eigenvalues", "nine of any size", "extremes of nine"],
)
def test_bfloat16_autocast_rounds_nothing_of_the_loss_and_its_gradient(raw: torch.Tensor) -> None:
    """At positions on the edge of the field; as in training, where the backbone alone may be rounded."""
    raw = raw.clone().requires_grad_()
    for xyz in data_set_positions().float():
        with torch.autocast("cpu", torch.bfloat16):
            value = loss(raw, xyz)
        (gradient,) = torch.autograd.grad(value.sum(), raw)
        assert value.isfinite().all()
        assert gradient.isfinite().all()
        (plain,) = torch.autograd.grad(loss(raw, xyz).sum(), raw)
        torch.testing.assert_close(gradient, plain, rtol=0, atol=0)


def data_set_positions() -> torch.Tensor:
    """Positions with |v_p| <= 1 in each coordinate and z_p in [1/D, D] for D = 5/3, all of them at their extremes."""
    corners = torch.tensor(list(itertools.product((-1.0, 1.0), (-1.0, 1.0), (0.6, 1.0, 5 / 3))), dtype=torch.float64)
    z = corners[:, 2:] * MU_Z0 * F
    return torch.cat([corners[:, :2] * S * z / (2 * F), z], dim=-1)


def gradients(raw: torch.Tensor) -> torch.Tensor:
    """The gradient of the loss in the raw numbers, one row for each extreme position."""
    raw = raw.clone().requires_grad_()
    return torch.stack([torch.autograd.grad(loss(raw, xyz).sum(), raw)[0] for xyz in data_set_positions()])


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0, 1e4])
def test_gradients_are_bounded(scale: float) -> None:
    """By constants over a data set with D = 5/3, but for w_2: its bound grows as 1/a where a < 1.

    The paper's proof leaves out log nu_z, whose slope at w_2 = 0 is 1/a.
    """
    raw = torch.cat([raw_numbers(1000, scale, seed=3), EXTREMES.double() * scale / 1e4])
    slopes = gradients(raw)
    D, a = 5 / 3, torch.where(raw[:, 5] < 0, raw[:, 5].exp(), raw[:, 5] + 1)
    slope_of_log_nu_z = 1 / (a + raw[:, 6].abs()).clamp_min(torch.finfo(raw.dtype).eps)
    rounding = 1 + 1e-9
    assert (slopes[..., :2].norm(dim=-1) <= D * rounding).all()
    assert (slopes[..., 2:5].norm(dim=-1) <= (D + 1) * math.sqrt(2) * rounding).all()
    assert (slopes[..., 5].abs() <= 5).all()
    assert (slopes[..., 6].abs() <= (D + slope_of_log_nu_z) * rounding).all()


def convex_points(n: int, scale: float, seed: int) -> torch.Tensor:
    """Raw numbers with B > I and a > 1: this set is convex, so the segments between its points stay in it."""
    raw = raw_numbers(n, scale, seed)
    root = raw_numbers(n, math.sqrt(scale), seed + 1)[:, :4].unflatten(-1, (2, 2))
    M = root @ root.mT
    b = torch.stack([M[:, 0, 0], math.sqrt(2) * M[:, 0, 1], M[:, 1, 1]], dim=-1)
    return torch.cat([raw[:, :2], b, raw[:, 5:6].abs(), raw[:, 6:]], dim=-1)


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0, 100.0])
def test_loss_without_log_nu_z_is_convex_in_the_outputs(scale: float) -> None:
    """Along chords of the region B > I, a > 1.

    log nu_z itself is concave for w_2 > 0 (the paper's proof leaves it out): its curvature, -1/(a + w_2)^2, is all
    that the loss lacks to be convex.
    """

    def convex_part(raw: torch.Tensor, xyz: torch.Tensor) -> torch.Tensor:
        distribution = ProjectedHuber.from_raw(raw, f=F, S=S, mu_z0=MU_Z0)
        return -distribution.log_prob(xyz) - distribution.mu_z.log()

    one, other = convex_points(200, scale, seed=4), convex_points(200, scale, seed=6)
    xyz = data_set_positions()[:, None]
    for share in (0.5, 0.1):
        chord = (1 - share) * convex_part(one, xyz) + share * convex_part(other, xyz)
        value = convex_part((1 - share) * one + share * other, xyz)
        assert (value <= chord + 1e-9 * chord.abs().clamp_min(1)).all()


def test_curvature_that_the_loss_lacks_is_that_of_log_nu_z() -> None:
    """At w_2 > 0 and z_p < nu_z the loss is linear plus log(a + w_2) in w_2: a counterexample to convexity."""
    raw = torch.tensor([0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 1.5], dtype=torch.float64)
    curvature = torch.autograd.functional.hessian(lambda raw: loss(raw, XYZ[0]), raw)[6, 6]
    assert curvature.item() == pytest.approx(-1 / (3.0 + 1.5) ** 2)
