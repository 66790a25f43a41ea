"""Distances from calibration that a calibrated model has: they cannot be zero for finitely many samples."""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import draws
from phd_exp.metrics.calibration import ence_of, miscalibration_area_of, uniform_distance_of
from phd_exp.metrics.calibration_scores import ence_bins
from phd_exp.metrics.ordered import in_order_of

SIMULATIONS = 200
SEED = 1
_AT_ONCE = 10**6
"""Positions that are drawn at a time."""
DISTANCES = ("depth_ence", "projected_ence", "miscalibration_area", "depth_pit_area", "depth_pit_ks")


@dataclass(frozen=True)
class Band:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float


def calibrated_reference(
    distribution: ProjectedHuber, simulations: int = SIMULATIONS, seed: int = SEED
) -> dict[str, Band]:
    """Median and 95 % interval of the `DISTANCES` over truths drawn from a batch of predictions themselves.

    ENCE depends on the predicted densities, so positions are drawn from them. Credible levels and PITs of a
    calibrated model are uniform whatever it predicts: their distances depend on the number of samples alone.

    Source: the simulated null distribution of a test statistic; coverage in tests/evaluation/test_reference.py.
    """
    (n,) = distribution.batch_shape
    found = {name: list(values) for name, values in _uniform(n, simulations, seed).items()}
    found |= {"depth_ence": [], "projected_ence": []}
    each = max(1, _AT_ONCE // n)
    for start in range(0, simulations, each):
        for name, values in _ence(distribution, min(each, simulations - start), seed + start).items():
            found[name] += values.tolist()
    return {name: _band(torch.tensor(found[name])) for name in DISTANCES}


def _ence(distribution: ProjectedHuber, simulations: int, seed: int) -> dict[str, Tensor]:
    drawn = draws(distribution, simulations, seed)
    z = drawn[..., 2]
    off_centre = drawn[..., :2] / z[..., None] - distribution.mu_xy
    pairs = {
        "depth_ence": (distribution.depth_variance, (z - distribution.depth_mean).square()),
        "projected_ence": (
            distribution.projected_covariance.diagonal(dim1=-2, dim2=-1).sum(-1),
            off_centre.square().sum(-1),
        ),
    }
    found = {}
    for name, (variance, error) in pairs.items():
        order = in_order_of(variance, {"variance": variance, "error": error}, torch.ones_like(error))
        found[name] = ence_of(order, "variance", "error", ence_bins(order))
    return found


@cache
def _uniform(n: int, simulations: int, seed: int) -> dict[str, tuple[float, ...]]:
    generator = torch.Generator().manual_seed(seed)
    areas, distances = [], []
    for _ in range(simulations):
        order = in_order_of(torch.rand(n, generator=generator, dtype=torch.float64), {})
        areas.append(float(miscalibration_area_of(order)))
        distances.append(float(uniform_distance_of(order)))
    return {
        "miscalibration_area": tuple(areas),
        "depth_pit_area": tuple(areas),
        "depth_pit_ks": tuple(distances),
    }


def _band(values: Tensor) -> Band:
    low, value, high = (
        values.double().quantile(torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64)).tolist()
    )
    return Band(value, low, high)
