"""Charts: one law each for the inverse, the Jacobian and the centre; and the constants that scale depth."""

import math

import pytest
import torch

from phd_exp.geometry import Camera, Cartesian, Chart, DepthScale, LogDepth, Projected

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
CAMERA = Camera(torch.tensor([1200.0, 1500.0, 1500.0, 2000.0], dtype=torch.float64), 224.0)
XYZ = torch.tensor([[0.1, -0.2, 3.0], [-0.3, 0.25, 4.0], [0.0, 0.0, 3.75], [0.2, 0.1, 5.0]], dtype=torch.float64)
CHARTS = [Projected(DEPTH), LogDepth(DEPTH), Cartesian(DEPTH), Cartesian(DEPTH, xy_unit=0.5)]


@pytest.fixture(params=CHARTS, ids=repr)
def chart(request: pytest.FixtureRequest) -> Chart:
    return request.param


def test_position_inverts_coordinates(chart: Chart) -> None:
    torch.testing.assert_close(chart.position(chart.coordinates(XYZ, CAMERA), CAMERA), XYZ)


def test_jacobian_is_that_of_autograd(chart: Chart) -> None:
    for xyz, f, log_det in zip(XYZ, CAMERA.f, chart.log_abs_det_jacobian(XYZ, CAMERA), strict=True):
        jacobian = torch.autograd.functional.jacobian(
            lambda xyz, f=f: chart.coordinates(xyz, Camera(f, CAMERA.S)), xyz
        )
        torch.testing.assert_close(torch.linalg.slogdet(jacobian).logabsdet, log_det)


def test_coordinates_are_of_order_one_over_the_data_set(chart: Chart) -> None:
    corners = [(u * 112 * z / f, v * 112 * z / f, z, f) for u in (-1, 1) for v in (-1, 1) for z in (3, 5)
               for f in (1200, 2000)]  # fmt: skip
    corners = torch.tensor(corners, dtype=torch.float64)
    coordinates = chart.coordinates(corners[:, :3], Camera(corners[:, 3], 224.0))
    assert coordinates.abs().max() < 2


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_coordinates_do_not_change_when_the_image_is_resized(factor: float) -> None:
    camera = Camera(factor * CAMERA.f, factor * CAMERA.S)
    for make in (Projected, LogDepth, Cartesian):
        resized = make(DEPTH.scaled(factor)).coordinates(XYZ, camera)
        torch.testing.assert_close(resized, make(DEPTH).coordinates(XYZ, CAMERA))


def test_definitions_of_the_baselines() -> None:
    xyz, one = XYZ[1], Camera(CAMERA.f[1], CAMERA.S)  # (-0.3, 0.25, 4) seen with f = 1500
    v_p = [2 * 1500 * -0.3 / (224 * 4), 2 * 1500 * 0.25 / (224 * 4)]
    z_p = 4 / (2.5e-3 * 1500)
    expected = {
        Projected: [*v_p, z_p - 1],
        LogDepth: [*v_p, math.log(z_p) / (5 / 3)],
        Cartesian: [-0.3 / 0.25, 0.25 / 0.25, 0.0],
    }
    for make, coordinates in expected.items():
        torch.testing.assert_close(make(DEPTH).coordinates(xyz, one), torch.tensor(coordinates, dtype=torch.float64))


def test_depth_scale_is_that_of_the_papers_ranges_or_of_samples() -> None:
    assert (DEPTH.mu_z0, DEPTH.D, DEPTH.z_centre) == pytest.approx((2.5e-3, 5 / 3, 4.0))
    z = torch.tensor([3.0, 5.0, 4.0], dtype=torch.float64)
    f = torch.tensor([2000.0, 1200.0, 1500.0], dtype=torch.float64)
    scale = DepthScale.from_samples(z, f)
    assert (scale.mu_z0, scale.D, scale.z_centre) == pytest.approx((DEPTH.mu_z0, DEPTH.D, DEPTH.z_centre))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 2.0, 4.0), "mu_z0 must be positive and finite, but is 0.0"),
        ((2.5e-3, 0.5, 4.0), "D must be at least 1 and finite, but is 0.5"),
        ((2.5e-3, float("nan"), 4.0), "D must be at least 1"),
        ((2.5e-3, 2.0, -4.0), "z_centre must be positive and finite, but is -4.0"),
    ],
)
def test_depth_scale_refuses_impossible_constants(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DepthScale(*arguments)
    for bad in ((0.0, 5.0), (5.0, 3.0), (1.0, float("inf"))):
        with pytest.raises(ValueError, match="range must be"):
            DepthScale.from_ranges(f_range=bad, z_range=bad)
