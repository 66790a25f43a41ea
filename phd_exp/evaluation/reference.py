"""The scores that a calibrated model would have: for finitely many samples, no distance from calibration is zero."""

from functools import cache, lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import NEES, Columns, draws, nees_columns, parameter_columns, squared_error_columns
from phd_exp.metrics.bootstrap import Interval
from phd_exp.metrics.calibration import ence_of, miscalibration_area, uniform_distance
from phd_exp.metrics.calibration_scores import ence_bins
from phd_exp.metrics.errors import MILLIMETRES
from phd_exp.metrics.groups import DIRECTIONS, similar_groups, worst_group
from phd_exp.metrics.ordered import Ordered, in_order_of

SEED = 1
_SHARES = torch.tensor([0.5, 0.025, 0.975], dtype=torch.float64)
_AT_ONCE = 50_000  # samples simulated at a time: more take the processor's time for memory
_DRAWS, _FEWEST_DRAWS = 30_000, 100
"""Positions drawn from all predictions, and at least from each."""
_EXPECTED = {"nees": 3.0, "nees_x": 1.0, "nees_y": 1.0, "nees_z": 1.0}
_SIMULATED, _FEWEST_SIMULATIONS = 400_000, 1000
"""Samples of all simulated test sets together, and the fewest test sets."""
REFERENCED = (
    *("depth_ence", "projected_ence", "inside_90", "miscalibration_area", "depth_pit_area", "depth_pit_ks"),
    *("group_miscalibration", "depth_crps_mm", *NEES),
)


def calibrated_reference(distribution: ProjectedHuber, simulations: int = 4000) -> dict[str, Interval[float]]:
    """Median and 95 % interval of the scores `REFERENCED` if the truths were drawn from the predictions themselves.

    ENCE, CRPS and NEES depend on the predicted densities, so positions are drawn from them: each simulated test set
    takes one of many draws from each prediction. Credible levels and PITs of a calibrated model are uniform for any
    prediction: their scores depend on the number of samples alone, and on the groups. The number inside a region is
    binomial. Of many samples, fewer test sets are simulated where draws or groups count.

    Source: the simulated null distribution of a test statistic; coverage in tests/evaluation/test_reference.py.
    """
    (n,) = distribution.batch_shape
    times = min(simulations, max(_FEWEST_SIMULATIONS, _SIMULATED // n))
    many = min(simulations, max(_FEWEST_DRAWS, _DRAWS // n))
    squared = squared_error_columns(distribution, distribution.mode)
    variances = {name: squared[f"{name}_variance"] for name in ("depth", "projected")}
    scored = _scored(distribution, draws(distribution, many, SEED), variances)
    generator = torch.Generator().manual_seed(SEED)
    parts = [_simulated(scored, variances, size, generator) for size in _sizes(n, times)]
    found = {name: torch.cat([part[name] for part in parts]) for name in parts[0]} | _uniform(n, simulations)
    found["group_miscalibration"] = _of_groups(groups_of(distribution).numpy().tobytes(), n, times)
    bands = {name: values.double().quantile(_SHARES) for name, values in found.items()}
    from scipy import stats  # takes half a second

    bands["inside_90"] = 100 * torch.from_numpy(stats.binom.ppf(_SHARES, n, 0.9)) / n
    return {name: Interval(*bands[name].tolist()) for name in REFERENCED}


def groups_of(distribution: ProjectedHuber) -> Tensor:
    """The groups of samples with similar parameters, as of `similar_groups`."""
    return similar_groups(torch.stack(list(parameter_columns(distribution).values()), -1))


def _scored(distribution: ProjectedHuber, drawn: Float[Tensor, "draws samples 3"], variances: Columns) -> Columns:
    """The scores of each draw, (samples, draws), scaled to their exact means over all predictions where known."""
    crps = {"depth_crps_mm": MILLIMETRES * distribution.depth_crps(drawn[..., 2])}
    columns = nees_columns(distribution, drawn) | squared_error_columns(distribution, drawn) | crps
    expected = _EXPECTED | {f"{name}_squared_error": float(variance.mean()) for name, variance in variances.items()}
    columns |= {name: columns[name] * (mean / columns[name].mean()) for name, mean in expected.items()}
    return {name: column.mT.contiguous() for name, column in columns.items() if column.ndim > 1}


def _simulated(scored: Columns, variances: Columns, size: int, generator: torch.Generator) -> Columns:
    """The scores of test sets that take one of the draws from each prediction."""
    n, many = scored["nees"].shape
    chosen = torch.randint(many, (n, size), generator=generator)
    columns = {name: column.gather(-1, chosen).mT for name, column in scored.items()}
    found = {name: columns[name].mean(-1) for name in (*NEES, "depth_crps_mm")}
    for name, variance in variances.items():
        order = in_order_of(variance, {"variance": variance, "error": columns[f"{name}_squared_error"]})
        found[f"{name}_ence"] = ence_of(order, "variance", "error", ence_bins(order))
    return found


@cache
def _uniform(n: int, simulations: int) -> Columns:
    """The scores of n uniform levels and PITs."""
    generator, found = torch.Generator().manual_seed(SEED), []
    for size in _sizes(n, simulations):
        levels = torch.rand(size, n, generator=generator, dtype=torch.float64).sort().values
        order = Ordered(levels, torch.ones_like(levels), {})
        found.append(torch.stack([miscalibration_area(order), uniform_distance(order)]))
    areas, distances = torch.cat(found, -1)
    return {"miscalibration_area": areas, "depth_pit_area": areas, "depth_pit_ks": distances}


@lru_cache(maxsize=2)
def _of_groups(groups: bytes, n: int, simulations: int) -> Tensor:
    """The worst-group miscalibration of uniform levels. A temperature keeps the groups."""
    generator = torch.Generator().manual_seed(SEED)
    members = torch.frombuffer(bytearray(groups), dtype=torch.float32).view(DIRECTIONS, -1, n)
    drawn = (torch.rand(size, n, generator=generator) for size in _sizes(n, simulations))
    return torch.cat([worst_group(levels, members, torch.ones_like(levels)) for levels in drawn])


def _sizes(n: int, simulations: int) -> list[int]:
    """How many test sets of n samples to simulate at a time."""
    most = max(1, _AT_ONCE // n)
    return [min(most, simulations - start) for start in range(0, simulations, most)]
