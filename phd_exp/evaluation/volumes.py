"""Volumes of regions of highest density: how much space a prediction needs for its coverage."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import Density
from phd_exp.distributions.columns import Columns, draws
from phd_exp.metrics.scores import DRAWS, energy_score

LOG_VOLUMES = {0.8: "log_volume_80", 0.9: "log_volume_90", 0.95: "log_volume_95", 0.99: "log_volume_99"}
"""Level -> the column with the log volume (m^3) of its region."""


def drawn_columns(distribution: Density, xyz: Float[Tensor, "samples 3"], seed: int) -> Columns:
    """`energy_score` (metres) at true positions and `LOG_VOLUMES`, by draws of each distribution.

    The volume of the region of a level is E[1/p; the draw is inside], for every density. With 64 draws the relative
    standard error of each sample's is a sixth for 90 %. The mean of the log is less than 0.01 off for up to 95 %.
    """
    drawn = draws(distribution, DRAWS, seed)
    level, energy = distribution.level(drawn), -distribution.log_prob(drawn)
    inside = {name: energy.masked_fill(level > end, -torch.inf) for end, name in LOG_VOLUMES.items()}
    volumes = {name: _log_mean_exp(values) for name, values in inside.items()}
    return {"energy_score": energy_score(drawn, xyz)} | volumes


def _log_mean_exp(values: Float[Tensor, "draws samples"]) -> Float[Tensor, " samples"]:
    """The log of the mean of exp(values), plus half its relative variance, by which it is too low on average."""
    n, total = len(values), values.logsumexp(0)
    of_one_draw = n * ((2 * values).logsumexp(0) - 2 * total).exp() - 1
    return total - math.log(n) + of_one_draw / (2 * n)
