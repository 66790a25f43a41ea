"""Scores of predictions: how sharp, how good as a whole, and whether uncertainty finds the bad ones."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.metrics.ordered import Ordered, in_order_of, require_finite

DRAWS = 64
"""Of a prediction, for its energy score."""
_CHUNK = 512
"""Rows whose pairs of draws are held in memory at once."""


def energy_score(
    samples: Float[Tensor, "draws *batch 3"], truth: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """E|X - v| - E|X - X'|/2 in the unit of positions, unbiased from independent draws; the CRPS of positions.

    The second mean is over all pairs of different draws, n (n - 1) of them.
    Raises ValueError for fewer than two draws.
    Source: Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007).
    """
    n = len(samples)
    if n < 2:
        raise ValueError(f"an energy score needs at least 2 draws, not {n}")
    to_truth = (samples - truth).norm(dim=-1).mean(0)
    rows = samples.reshape(n, -1, 3).movedim(0, 1).split(_CHUNK)
    pairs = torch.cat([_pair_distances(row) for row in rows]).reshape(truth.shape[:-1])
    return to_truth - pairs / (2 * n * (n - 1))


def _pair_distances(samples: Float[Tensor, "rows draws 3"]) -> Float[Tensor, " rows"]:
    # differences rather than products of matrices, which lose the digits of near draws
    return torch.cdist(samples, samples, compute_mode="donot_use_mm_for_euclid_dist").sum((-2, -1))


def sharpness(predicted_variance: Float[Tensor, " samples"]) -> Float[Tensor, ""]:
    """The root mean square of the predicted standard deviation; says nothing of whether it is right.

    Raises ValueError without samples, or with one that is not finite.
    """
    require_finite(predicted_variance)
    return predicted_variance.double().mean().sqrt()


@dataclass(frozen=True)
class RiskCoverage:
    """The mean error of the most certain samples, by the share of samples that they are.

    Areas are means of the risk over all coverages 1/n, 2/n, ..., 1: by predicted uncertainty, by the error itself
    (an oracle; nothing is lower) and in random order.
    """

    coverage: Float[Tensor, "*batch points"]
    risk: Float[Tensor, "*batch points"]
    area: Float[Tensor, "*batch"]
    oracle_area: Float[Tensor, "*batch"]
    random_area: Float[Tensor, "*batch"]

    @property
    def excess(self) -> Float[Tensor, "*batch"]:
        """(area - oracle) / (random - oracle): 0 finds the bad samples perfectly, 1 not at all."""
        return (self.area - self.oracle_area) / (self.random_area - self.oracle_area)


def risk_coverage(uncertainty: Float[Tensor, " samples"], error: Float[Tensor, " samples"]) -> RiskCoverage:
    """Keep the most certain samples: what is their mean error? Equally uncertain ones count as if in random order.

    Raises ValueError without samples, or with one that is not finite.
    Source: Geifman and El-Yaniv, "Selective classification for deep neural networks" (2017).
    """
    columns = {"error": error}
    return risk_coverage_of(in_order_of(uncertainty, columns), in_order_of(error, columns), "error")


def risk_coverage_of(by_uncertainty: Ordered, by_error: Ordered, error: str) -> RiskCoverage:
    """`risk_coverage` of samples in the order of their uncertainty and of their error."""
    kept = by_uncertainty.up_to
    return RiskCoverage(
        coverage=kept / by_uncertainty.total,
        risk=by_uncertainty.sums[error].cumsum(-1) / kept,
        area=_area_under_risk(by_uncertainty, error),
        oracle_area=_area_under_risk(by_error, error),
        random_area=by_uncertainty.mean(error),
    )


def risk_at(
    ordered: Ordered, error: str, coverage: Float[Tensor, " points"]
) -> Float[Tensor, "*batch points"]:
    """The risk at given coverages in (0, 1], of samples in the order of their uncertainty."""
    kept = torch.nn.functional.pad(ordered.up_to, (1, 0))
    errors = torch.nn.functional.pad(ordered.sums[error].cumsum(-1), (1, 0))
    wanted = coverage.double() * ordered.total
    after = (
        torch.searchsorted(kept[..., 1:].contiguous(), wanted.contiguous()).clamp_max(kept.shape[-1] - 2) + 1
    )
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
