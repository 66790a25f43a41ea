"""The seven constraints that the paper asks of a predicted density (section "Desired constraints")."""

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import HUBER_COVARIANCE
from phd_exp.geometry import Camera, Projected
from phd_exp.geometry.charts import DepthScale

F, S, MU_Z0 = 1500.0, 224.0, 2.5e-3
DEPTH = DepthScale.from_ranges((1200.0, 2000.0), (3.0, 5.0))


def in_field_of_view(n: int, f: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    u, v, z = torch.rand(3, n, generator=generator, dtype=torch.float64)
    pixel = S * torch.stack([u, v], dim=-1)
    return Camera(torch.tensor(f, dtype=torch.float64), S).unproject(pixel, 0.5 + 20 * z)


@pytest.mark.parametrize("projected_deviation", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("depth_precision", [1e-2, 1.0, 1e3])
def test_1_any_depth_variance_goes_with_any_projected_covariance(
    projected_deviation: float, depth_precision: float
) -> None:
    wanted = projected_deviation**2 * torch.tensor([[2.0, 0.6], [0.6, 1.0]], dtype=torch.float64)
    s, U = torch.linalg.eigh(wanted / HUBER_COVARIANCE)
    A = U @ torch.diag(s.rsqrt()) @ U.T
    a = torch.tensor(depth_precision, dtype=torch.float64)
    centre = torch.zeros(2, dtype=torch.float64), torch.tensor(4.0, dtype=torch.float64)
    distribution = ProjectedHuber(*centre, (A + A.T) / 2, a)
    torch.testing.assert_close(distribution.projected_covariance, wanted)
    other = ProjectedHuber(*centre, torch.eye(2, dtype=torch.float64), a)
    torch.testing.assert_close(distribution.depth_variance, other.depth_variance)


@pytest.mark.parametrize("zoom", [0.8, 1.25, 3.0])
def test_2_the_focal_length_matters_only_through_the_projection_and_z_over_f(zoom: float) -> None:
    """The same raw numbers give the same density over (v_p, z/f), whatever f is."""
    raw = torch.tensor([0.4, -0.8, 1.3, 0.7, 2.1, 3.0, -0.9], dtype=torch.float64)
    chart, densities = Projected(DEPTH), []
    coordinates = chart.coordinates(in_field_of_view(50, F), Camera(torch.tensor(F, dtype=torch.float64), S))
    for f in (F, zoom * F):
        camera = Camera(torch.tensor(f, dtype=torch.float64), S)
        xyz = chart.position(coordinates, camera)
        log_prob = ProjectedHuber.from_raw(raw, f=f, S=S, mu_z0=MU_Z0).log_prob(xyz)
        densities.append(log_prob - chart.log_abs_det_jacobian(xyz, camera))
    torch.testing.assert_close(*densities)


def test_3_nothing_is_behind_the_camera(distribution: ProjectedHuber) -> None:
    behind = in_field_of_view(50, F) * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    assert (distribution.log_prob(behind) == -torch.inf).all()


def test_4_everything_in_the_field_of_view_is_possible(distribution: ProjectedHuber) -> None:
    assert distribution.log_prob(in_field_of_view(500, F)).isfinite().all()


def test_5_minus_log_p_is_convex_in_the_position(distribution: ProjectedHuber) -> None:
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(2)
    near, far = distribution.sample(torch.Size([2, 1000])), in_field_of_view(2000, F).unflatten(0, (2, 1000))
    share = torch.rand(1000, 1, generator=generator, dtype=torch.float64)
    for one, other in ((near[0], near[1]), (near[0], far[0]), (far[0], far[1])):
        chord = torch.lerp(distribution.log_prob(one), distribution.log_prob(other), share.squeeze(-1))
        value = distribution.log_prob(torch.lerp(one, other, share))
        assert (value >= chord - 1e-9 * chord.abs().clamp_min(1)).all()


def test_6_the_density_vanishes_at_infinity_and_at_the_camera(distribution: ProjectedHuber) -> None:
    top = distribution.log_prob(distribution.mode)
    directions = torch.nn.functional.normalize(in_field_of_view(50, F), dim=-1)
    sideways = torch.tensor([[1.0, 0.0, 1e-3], [0.0, -1.0, 1e-3]], dtype=torch.float64)
    for ray in (directions, sideways):
        assert (distribution.log_prob(1e6 * ray) < top - 1000).all()
    for depth in (1e-6, 1e-9):
        near = distribution.mode * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) + torch.tensor(
            [0, 0, depth]
        )
        assert distribution.log_prob(near) < top - 1000
    assert (distribution.log_prob(1e-8 * directions) < top - 1000).all()


def test_7_the_density_is_continuous(distribution: ProjectedHuber) -> None:
    """Across the two borders between its pieces, |q| = 1 and z = mu_z."""
    mode, mu_z = distribution.mode, distribution.mu_z
    sideways = torch.linalg.inv(distribution.A)[0] * mu_z  # |q| = 1 here, at the depth of the mode
    borders = [
        mode + torch.cat([sideways, torch.zeros(1, dtype=torch.float64)]),
        mode + torch.tensor([0.01, -0.02, 0.0], dtype=torch.float64),
    ]
    for border in borders:
        for step in torch.eye(3, dtype=torch.float64) * 1e-10:
            difference = distribution.log_prob(border + step) - distribution.log_prob(border - step)
            assert difference.abs() < 1e-5
