"""Split-conformal regions: held-out samples that are used for nothing else guarantee a coverage.

The score of a sample is the credible level of its true position. The threshold is the k-th smallest of n scores with
k = ceil((n + 1) c). A further sample, exchangeable with these, lies in its region of that level with a probability
from c to c + 1/(n + 1), for any network. Given the n samples, the coverage has the law Beta(k, n + 1 - k).

Samples of one block, such as the frames of a video, are dependent, but the blocks are exchangeable. Each of n blocks
then has the weight 1/(n + 1), shared by its samples, and a sample of a further block is covered.

Source: Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World" (2005), also for groups (Mondrian); for
blocks Lee, Barber and Willett, "Distribution-free inference with hierarchical data" (2023).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import ProjectedHuber, Temperature
from phd_exp.distributions.regions import Region
from phd_exp.evaluation.parquet import Arrays, require_columns
from phd_exp.evaluation.predictions import Rows, at_temperature
from phd_exp.evaluation.several_views import read_views
from phd_exp.evaluation.volumes import LOG_VOLUMES
from phd_exp.fusion import fuse
from phd_exp.metrics.errors import squared_mahalanobis
from phd_exp.records.errors import RunError
from phd_exp.records.runs import choosing

Groups = Literal["spread", "truncation", "focal_length"]
GROUPED_BY: Mapping[Groups | None, Callable[[ProjectedHuber, Tensor], Tensor]] = {
    None: lambda p, f: torch.zeros_like(p.a),
    "spread": lambda p, f: p.variance.sum(-1).sqrt(),
    "truncation": lambda p, f: 1 - (2 * f[..., None] * p.mu_xy).abs().amax(-1),
    "focal_length": lambda p, f: f,
}
"""What a camera knows, given f in sides of the image: the predicted standard deviation of the position (m), the
distance of the predicted projection from the border of the image (half sides), and f.
"""
PARTS = 4  # groups, of equal size among the held-out samples that may choose


@dataclass(frozen=True, eq=False)
class Guarantee:
    """The levels of the regions with a coverage, by `n` blocks of samples each, between `edges` of a quantity."""

    coverage: float
    groups: Groups | None
    edges: Float[np.ndarray, " edges"]
    levels: list[float]
    n: list[int]

    def region(self, prediction: ProjectedHuber, f: float) -> tuple[Region, dict[str, Any]]:
        """The region of one prediction, and its guarantee for JSON; f is the focal length in sides of the image."""
        region, (facts,) = self.regions(prediction, np.array(f))
        return region, facts

    def regions(
        self, predictions: ProjectedHuber, f: Float[np.ndarray, "*batch"]
    ) -> tuple[Region, list[dict[str, Any]]]:
        """The regions of predictions, and the guarantee of each, as `region`."""
        quantity = GROUPED_BY[self.groups](predictions, torch.from_numpy(f))
        places = np.searchsorted(self.edges, quantity.numpy(), side="right")
        return Region(predictions, np.array(self.levels)[places]), [*map(self._facts, np.ravel(places).tolist())]

    def _facts(self, place: int) -> dict[str, Any]:
        facts = {"coverage": self.coverage, "level": self.levels[place], "held_out_samples": self.n[place]}
        ends = [None, *self.edges.tolist(), None][place : place + 2]
        return facts | ({self.groups: ends} if self.groups else {})


def guarantee(
    held_out: Arrays,
    coverage: float,
    groups: Groups | None,
    temperature: Temperature | None,
    origin: str = "held-out samples, every second of data.n_held_out",
) -> Guarantee:
    """The guarantee by recorded predictions of held-out samples, recalibrated if a temperature is given.

    Raises RunError, which names the origin of the samples, if there are too few, or too many positions of level 1.
    """

    def scored(rows: Rows) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"], np.ndarray]:
        """The levels of the true positions, the quantities of the groups, and the blocks."""
        p, xyz, columns = at_temperature(held_out, temperature, rows)
        require_columns(("f", "S") if groups else (), columns)
        f = torch.from_numpy(columns["f"] / columns["S"]) if groups else p.a
        return p.level(xyz).numpy(), GROUPED_BY[groups](p, f).numpy(), columns.get("block", np.arange(len(xyz)))

    chooses = choosing(held_out)
    (_, chosen, _), (scores, values, block) = scored(chooses), scored(~chooses)
    edges = np.unique(np.quantile(chosen, np.arange(1, PARTS) / PARTS))
    edges = edges[edges > chosen.min()]  # equal values are one group
    place = np.searchsorted(edges, values, side="right")
    parts = [(scores[place == group], block[place == group]) for group in range(len(edges) + 1)]
    samples = origin.replace(",", " of each group,") if groups else origin
    levels = [threshold(part, coverage, samples, of_part) for part, of_part in parts]
    if max(levels) == 1:
        raise RunError(f"coverage: got {coverage}; too many true positions have level 1; try recalibrate=true")
    return Guarantee(coverage, groups, edges, levels, [len(np.unique(of_part)) for _, of_part in parts])


def fused_guarantee(file: Path, k: int, coverage: float, temperature: Temperature | None) -> dict[str, Any]:
    """The squared Mahalanobis distance from the fused mean of k cameras that has the coverage, and its n, for JSON.

    Raises RunError if the run has no recorded scenes of k cameras, or too few that guarantee.
    """
    views = read_views(file) if file.exists() else None
    if views is None or views.views < k:
        raise RunError(
            f"{file}: no scenes with {k} cameras, as coverage= needs; train with data=scale "
            f"evaluation.multiview.scenes=500 evaluation.multiview.views={max(k, 2)}"
        )
    views = views.cameras(k).subset(views.columns["scene"][:, 0] % 2 == 1)
    fused = fuse(temperature.apply(views.predictions) if temperature else views.predictions, views.pose)
    distance = squared_mahalanobis(views.truth - fused.mean, fused.covariance)
    scores = distance[distance.isfinite()].numpy()
    found = threshold(scores, coverage, "scenes, every second of evaluation.multiview.scenes")
    return {"coverage": coverage, "squared_mahalanobis": found, "held_out_samples": len(scores)}


def conformal_log_volumes(table: Arrays, held_out: Arrays, coverage: float = 0.9) -> Arrays:
    """Column `log_volume`: the log volume (m^3) of each sample's region with a guaranteed coverage.

    Held-out samples set the level of the regions, so that densities are compared at equal coverage. Between the
    recorded levels, the log volume is interpolated linearly in log(level / (1 - level)).

    Raises RunError for too few held-out samples, or missing columns.
    """
    require_columns(LOG_VOLUMES.values(), table)
    require_columns(("level",), held_out)
    level = level_threshold(held_out, coverage)
    ends, values = np.array(list(LOG_VOLUMES)), np.stack([table[name] for name in LOG_VOLUMES.values()])
    at, ends = (np.log(number / (1 - number)) for number in (np.clip(level, ends[0], ends[-1]), ends))
    place = min(int(np.searchsorted(ends, at, "right")), len(ends) - 1)
    share = (at - ends[place - 1]) / (ends[place] - ends[place - 1])
    return {"log_volume": (1 - share) * values[place - 1] + share * values[place]}


def level_threshold(held_out: Arrays, coverage: float) -> float:
    """The `threshold` of the levels of held-out samples that guarantee; 1 where a prediction was not finite."""
    guarantees = ~choosing(held_out)
    block = held_out["block"][guarantees] if "block" in held_out else None
    return threshold(np.nan_to_num(held_out["level"][guarantees], nan=1.0), coverage, "held-out samples", block)


def threshold(
    scores: Float[np.ndarray, " samples"], coverage: float, samples: str, block: np.ndarray | None = None
) -> float:
    """The k-th smallest score; of dependent samples, the least up to which the weights of n blocks reach k/(n + 1).

    Raises ValueError for a score that is not a number, and RunError with the number of `samples` needed if there are
    too few.
    """
    if np.isnan(scores).any():
        raise ValueError(f"scores: got {int(np.isnan(scores).sum())} that are not numbers; expected none")
    if not 0 < coverage < 1:
        raise RunError(f"coverage: got {coverage}; expected a probability between 0 and 1, such as 0.9")
    _, place, size = np.unique(np.arange(len(scores)) if block is None else block, False, True, True)
    n, c = len(size), Fraction(str(coverage))  # exact: 10 * 0.9 is 9
    if math.ceil((n + 1) * c) > n:
        samples = samples if n == len(scores) else f"blocks (track, scene or image) of {samples}"
        raise RunError(f"coverage: got {coverage}; needs at least {samples_needed(coverage)} {samples}; found {n}")
    order = scores.argsort()
    weight = (1 / size[place])[order].cumsum()
    return float(scores[order][np.searchsorted(weight, float((n + 1) * c) - 1e-9)])


def samples_needed(coverage: float) -> int:
    """The least number of samples that can guarantee a coverage."""
    c = Fraction(str(coverage))
    return math.ceil(c / (1 - c))
