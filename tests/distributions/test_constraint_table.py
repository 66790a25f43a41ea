"""The seven constraints measured on all models, beside what theory says of each."""

import math

import pytest
import torch
from numpy.polynomial.legendre import leggauss

from phd_exp.distributions import PointEstimate
from phd_exp.distributions.constraints import CONSTRAINTS, DEPTH, families
from phd_exp.distributions.point_density import PointDensity
from phd_exp.geometry import Camera, Cartesian, LogDepth, Projected

KEPT = {
    # every one of them, by construction
    "probabilistic": {1, 2, 3, 4, 5, 6, 7},
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
    places = [
        torch.cat([-(1 - nodes) / 2, (1 + nodes) / 2]) * h + c for h, c in zip(half, centre, strict=True)
    ]
    weight = torch.cat([weights, weights]) / 2
    grid = torch.stack(torch.meshgrid(*places, indexing="ij"), dim=-1)
    volume = torch.einsum("i,j,k->ijk", weight, weight, weight) * half.prod()
    mass = float((density.log_prob(grid).exp() * volume).sum())
    assert mass == pytest.approx(share, abs=5 * math.sqrt(share / 200_000))
