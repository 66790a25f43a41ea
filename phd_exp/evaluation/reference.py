"""The scores that a calibrated model would have: for finitely many samples, no distance from calibration is zero."""

from collections import defaultdict
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import NEES, draws, nees_columns, parameter_columns, squared_error_columns
from phd_exp.metrics.calibration import ence_of, miscalibration_area, uniform_distance
from phd_exp.metrics.calibration_scores import ence_bins
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.groups import similar_groups, worst_group
from phd_exp.metrics.ordered import in_order_of

SEED = 1
_AT_ONCE = 10**6  # positions drawn at a time
REFERENCED = (
    *("depth_ence", "projected_ence", "inside_90", "miscalibration_area", "depth_pit_area", "depth_pit_ks"),
    *("group_miscalibration", "depth_crps_mm", *NEES),
)


@dataclass(frozen=True)
class Band:
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float


def calibrated_reference(distribution: ProjectedHuber, simulations: int = 200) -> dict[str, Band]:
    """Median and 95 % interval of the scores `REFERENCED` if the truths were drawn from the predictions themselves.

    ENCE, CRPS and NEES depend on the predicted densities, so positions are drawn from them. Credible levels and PITs
    of a calibrated model are uniform for any prediction: their scores depend on the number of samples alone.

    Source: the simulated null distribution of a test statistic; coverage in tests/evaluation/test_reference.py.
    """
    (n,) = distribution.batch_shape
    found = defaultdict(list, _uniform(n, simulations))
    each = max(1, _AT_ONCE // n)
    for start in range(0, simulations, each):
        for name, values in _simulated(distribution, min(each, simulations - start), SEED + start).items():
            found[name] += values.tolist()
    shares = torch.tensor([0.5, 0.025, 0.975], dtype=torch.float64)
    return {name: Band(*torch.tensor(values).double().quantile(shares).tolist()) for name, values in found.items()}


def groups_of(distribution: ProjectedHuber) -> Tensor:
    """The groups of samples with similar parameters, as of `similar_groups`."""
    return similar_groups(torch.stack(list(parameter_columns(distribution).values()), -1))


def _simulated(distribution: ProjectedHuber, simulations: int, seed: int) -> dict[str, Tensor]:
    drawn = draws(distribution, simulations, seed)
    found = {name: values.mean(-1) for name, values in nees_columns(distribution, drawn).items()}
    found["depth_crps_mm"] = MILLIMETRES * distribution.depth_crps(drawn[..., 2]).mean(-1)
    levels = torch.rand(drawn.shape[:-1], generator=torch.Generator().manual_seed(seed))
    found["group_miscalibration"] = worst_group(levels, groups_of(distribution), torch.ones_like(levels))
    squared = squared_error_columns(distribution, drawn)
    for name in ("depth", "projected"):
        variance, error = squared[f"{name}_variance"], squared[f"{name}_squared_error"]
        order = in_order_of(variance, {"variance": variance, "error": error}, torch.ones_like(error))
        found[f"{name}_ence"] = ence_of(order, "variance", "error", ence_bins(order))
    return found


@cache
def _uniform(n: int, simulations: int) -> dict[str, list[float]]:
    """The scores of n uniform levels and PITs."""
    generator = torch.Generator().manual_seed(SEED)
    inside, areas, distances = [], [], []
    for _ in range(simulations):
        levels = torch.rand(n, generator=generator, dtype=torch.float64)
        order = in_order_of(levels, {})
        inside.append(100 * float((levels <= 0.9).double().mean()))
        areas.append(float(miscalibration_area(order)))
        distances.append(float(uniform_distance(order)))
    return {"inside_90": inside, "miscalibration_area": areas, "depth_pit_area": areas, "depth_pit_ks": distances}
