"""The seven constraints measured on all models, beside what theory says of each."""

import math

import pytest
import torch
from numpy.polynomial.legendre import leggauss

from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.distributions.constraints import (
    CONSTRAINTS,
    DEPTH,
    Decomposed,
    Family,
    families,
    minus_log_is_convex,
)
from phd_exp.distributions.point_estimate import PointDensity
from phd_exp.geometry import Camera, Cartesian, LogDepth, Projected
from phd_exp.models.backbones import PooledFeatures
from phd_exp.models.heads import DistributionHead
from phd_exp.models.regressor import FocalLengthInput, Regressor

KEPT = {
    # every one of them, by construction
    "probabilistic": {1, 2, 3, 4, 5, 6, 7},
    # Proposition 1 of the paper: -log p is not convex in v
    "decomposed": {1, 2, 3, 4, 6, 7},
    # one spread for all; z_p may be negative; a ray's density is spread over z^2, so it is infinite at the camera;
    # distances in projection are not convex in v
    "mae_vz": {2, 4, 7},
    # log z needs z > 0, and z^(1/(D s) - 3) vanishes at the camera for a scale as small as this
    "mae_logz": {2, 3, 4, 6, 7},
    # convex, as the norm of an affine map, but blind to f, to the camera's plane and to what is behind it
    "mae_xyz": {4, 5, 7},
    # mae_vz, and blind to f
    "mae_constf": {4, 7},
}


@pytest.mark.parametrize("constraint", CONSTRAINTS)
@pytest.mark.parametrize("name", KEPT)
def test_a_model_keeps_the_constraints_that_theory_says_it_keeps(name: str, constraint: str) -> None:
    finding = CONSTRAINTS[constraint](families()[name], torch.Generator().manual_seed(3))
    assert finding.holds == (int(constraint.split()[0]) in KEPT[name]), finding


@pytest.mark.parametrize(
    "chart", [Projected(DEPTH), LogDepth(DEPTH), Cartesian(DEPTH)], ids=lambda c: type(c).__name__
)
def test_a_point_read_as_a_density_has_the_mass_of_its_samples(
    chart: Projected | LogDepth | Cartesian,
) -> None:
    """Quadrature of the density over a box around the estimate, against the share of samples in it."""
    camera = Camera(torch.tensor(1500.0, dtype=torch.float64), 224.0)
    centre = torch.tensor([0.05, -0.03, 4.0], dtype=torch.float64)
    density = PointDensity(PointEstimate(chart.coordinates(centre, camera), chart, camera), 0.1)
    half = torch.tensor([0.05, 0.05, 0.4], dtype=torch.float64)
    samples = density.rsample((200_000,), torch.Generator().manual_seed(0))
    share = float(((samples - centre).abs() < half).all(-1).double().mean())

    # one Gauss rule in each of the eight corners around the estimate, where the density has its kink
    nodes, weights = (torch.from_numpy(part) for part in leggauss(24))
    places = [torch.cat([-(1 - nodes) / 2, (1 + nodes) / 2]) * h + c for h, c in zip(half, centre, strict=True)]
    weight = torch.cat([weights, weights]) / 2
    grid = torch.stack(torch.meshgrid(*places, indexing="ij"), dim=-1)
    volume = torch.einsum("i,j,k->ijk", weight, weight, weight) * half.prod()
    mass = float((density.log_prob(grid).exp() * volume).sum())
    assert mass == pytest.approx(share, abs=5 * math.sqrt(share / 200_000))


def test_a_decomposed_density_has_the_mass_of_its_samples() -> None:
    """The mean of p/p' over samples of p' is 1 for every density p; ray and depth are independent."""
    parameters = ([0.05, -0.03], 4.0, [[30.0, 0.0], [0.0, 30.0]], 5.0)
    law = ProjectedHuber(*(torch.tensor(values, dtype=torch.float64) for values in parameters))
    decomposed, generator = Decomposed(law), torch.Generator().manual_seed(0)
    samples = decomposed.rsample((100_000,), generator)
    ratio = (law.log_prob(samples) - decomposed.log_prob(samples)).exp()
    assert float(ratio.mean()) == pytest.approx(1, abs=5 * float(ratio.std()) / math.sqrt(len(ratio)))
    rays = samples[:, :2] / samples[:, 2:]
    torch.testing.assert_close(rays.T.cov(), law.projected_covariance, rtol=0.05, atol=1e-4)
    correlation = torch.stack([rays.norm(dim=-1), samples[:, 2]]).corrcoef()[0, 1]
    assert abs(float(correlation)) < 0.02


@pytest.mark.parametrize(("depth_deviation", "holds"), [(0.2, True), (1.0, False)])
def test_a_decomposed_density_is_convex_only_where_depth_is_as_certain_as_the_ray(
    depth_deviation: float, holds: bool
) -> None:
    """The proof of Proposition 1: for Gaussian parts of deviations s and d, |H| > 0 needs d < s z/|x/z|, or 0.3 m."""

    class Gaussian:
        def log_prob(self, xyz: torch.Tensor) -> torch.Tensor:
            ray = xyz[..., :2] / xyz[..., 2:]
            return -(ray / 0.01).square().sum(-1) / 2 - ((xyz[..., 2] - 4) / depth_deviation).square() / 2

        rsample = log_prob  # never called

    family = Family(lambda raw, camera: Gaussian(), families()["probabilistic"].inputs)  # type: ignore[arg-type,return-value]
    assert minus_log_is_convex(family, torch.Generator().manual_seed(0)).holds is holds


@pytest.mark.parametrize("shown", [False, True])
def test_a_whole_network_to_which_f_is_shown_breaks_the_second_constraint(shown: bool) -> None:
    """Of random weights, last layers included; the head is the same."""
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(3, 8, 3), torch.nn.ReLU(), torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten()
    backbone = PooledFeatures(torch.nn.Sequential(*layers), 8)
    network = Regressor(backbone, DistributionHead(DEPTH), FocalLengthInput(7, DEPTH) if shown else None)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    network = network.double().eval()

    def images(n: int, generator: torch.Generator) -> torch.Tensor:
        return torch.randint(0, 256, (n, 16, 16, 3), dtype=torch.uint8, generator=generator)

    with torch.no_grad():
        finding = CONSTRAINTS["2 f enters only through (v_p, z/f)"](
            Family(network, images), torch.Generator().manual_seed(0)
        )
    assert finding.holds is not shown, finding
