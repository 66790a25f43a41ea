"""Scores of predictions: the energy score, and whether predicted uncertainty ranks the errors."""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics.ordered import Ordered

DRAWS = 64  # draws of a prediction for its energy score
_CHUNK = 512  # rows whose pairs of draws are held in memory at once


def energy_score(
    samples: Float[Tensor, "draws *batch 3"], truth: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """E|X - v| - E|X - X'|/2 in the unit of positions: the CRPS of positions, unbiased for independent draws.

    The second mean is over all n (n - 1) pairs of different draws. Raises ValueError for fewer than two draws.
    Source: Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007).

    Examples:
        >>> draws = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 5.0]])
        >>> float(energy_score(draws, torch.tensor([0.0, 0.0, 4.0])))  # distance 1 from the truth, 2 from each other
        0.0
    """
    n = len(samples)
    if n < 2:
        raise ValueError(f"an energy score needs at least 2 draws, not {n}")
    to_truth = (samples - truth).norm(dim=-1).mean(0)
    rows = samples.reshape(n, -1, 3).movedim(0, 1).split(_CHUNK)
    # differences rather than products of matrices, which lose the digits of near draws
    distances = partial(torch.cdist, compute_mode="donot_use_mm_for_euclid_dist")
    pairs = torch.cat([distances(row, row).sum((-2, -1)) for row in rows]).reshape(truth.shape[:-1])
    return to_truth - pairs / (2 * n * (n - 1))


def risk_coverage(
    by_uncertainty: Ordered, by_error: Ordered, error: str
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The area under the risk-coverage curve, and its excess, of samples ordered by uncertainty and by error.

    The curve is the mean of the column `error` of the most certain samples (risk) against their share of all samples
    (coverage); see `risk_at`. The area is the mean of the risk over the coverages 1/n, 2/n, ..., 1, in the unit of
    the error. Samples of equal uncertainty count as if in random order. With the oracle that sorts by the error
    itself, the lower bound, the excess is (area - oracle) / (random - oracle): 0 if uncertainty ranks the errors
    perfectly, 1 if at random.

    Source: Geifman and El-Yaniv, "Selective classification for deep neural networks" (2017).
    """
    area, oracle = _area_under_risk(by_uncertainty, error), _area_under_risk(by_error, error)
    return area, (area - oracle) / (by_uncertainty.mean(error) - oracle)


def risk_at(ordered: Ordered, error: str, coverage: Float[Tensor, " points"]) -> Float[Tensor, "*batch points"]:
    """The risk at given coverages in (0, 1], of samples ordered by their uncertainty."""
    kept = torch.nn.functional.pad(ordered.up_to, (1, 0))
    errors = torch.nn.functional.pad(ordered.sums[error].cumsum(-1), (1, 0))
    wanted = coverage.double() * ordered.total
    after = torch.searchsorted(kept[..., 1:].contiguous(), wanted.contiguous()).clamp_max(kept.shape[-1] - 2) + 1
    at = [values.gather(-1, place) for values in (kept, errors) for place in (after - 1, after)]
    share = ((wanted - at[0]) / (at[1] - at[0]).clamp_min(1)).clamp(0, 1)
    return torch.lerp(at[2], at[3], share) / wanted


def _area_under_risk(ordered: Ordered, error: str) -> Tensor:
    """The mean over k of the mean error of the first k samples, in random order within each group.

    With C samples and errors E before a group of c samples of mean e, its sum over k is
    c e + (E - C e) (H_(C+c) - H_C) with the harmonic numbers H.
    """
    kept, errors = ordered.up_to, ordered.sums[error]
    harmonic = torch.digamma(torch.nn.functional.pad(kept, (1, 0)) + 1).diff(dim=-1)
    mean = errors / ordered.count.clamp_min(1)
    before = errors.cumsum(-1) - errors - (kept - ordered.count) * mean
    return (errors + before * harmonic).sum(-1) / ordered.count.sum(-1)
