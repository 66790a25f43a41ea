"""How familiar a prediction is: its distance from those of held-out samples, as a p-value.

The features are log mu_z, log f, log a and log|A|, which leave out the place in the image, and for an ensemble the
log of its members' disagreement. The score is the distance to the fifth nearest held-out sample that may choose, in
units of their covariance. The other held-out samples make it a p-value: the share of them at least as far away,
counting the new sample too. It is uniform for samples like the held-out ones.

Source: Sun et al., "Out-of-distribution detection with deep nearest neighbors" (2022), here with outputs as features;
the p-value is the conformal one (Vovk, Gammerman and Shafer, "Algorithmic Learning in a Random World", 2005).
"""

import numpy as np
import torch
from jaxtyping import Float

from phd_exp.distributions import Temperature
from phd_exp.distributions.columns import parameter_columns
from phd_exp.evaluation.parquet import Arrays, require_columns
from phd_exp.evaluation.predictions import at_temperature
from phd_exp.records.errors import RunError
from phd_exp.records.runs import choosing

NEIGHBOURS = 5
FEWEST = 20  # held-out samples that may choose
ROWS = 1024  # samples at once, whose distances to all others are in memory
ALARM = 0.05  # the p-value below which a sample counts as unfamiliar
_LEAST_VARIANCE = 1e-4  # 1 % of a quantity that never varies, such as the f of a single camera
_FURTHEST = 1e3


class Familiarity:
    """The familiarity of predictions, by recorded predictions of held-out samples, recalibrated if asked.

    Raises RunError if there are too few.
    """

    def __init__(self, held_out: Arrays, temperature: Temperature | None = None) -> None:
        distribution, _, kept = at_temperature(held_out, temperature)
        require_columns(("f", "S"), kept)
        columns = kept | {name: column.numpy() for name, column in parameter_columns(distribution).items()}
        features = _features(columns)
        chooses = choosing(columns)
        chosen = features[chooses]
        if len(chosen) < FEWEST:
            raise RunError(f"familiar: needs at least {2 * FEWEST} held-out samples; found {len(features)}")
        self.middle = chosen.mean(0)
        variance, axes = np.linalg.eigh(np.cov(chosen.T))
        self.whiten = axes / np.sqrt(np.maximum(variance, _LEAST_VARIANCE))
        self.chosen = torch.from_numpy((chosen - self.middle) @ self.whiten)
        self.usual = np.sort(self.distance(columns)[~chooses])

    def distance(self, columns: Arrays) -> Float[np.ndarray, " samples"]:
        """The score of predictions with these parameters, f and S (px); larger for less familiar ones."""
        points = torch.from_numpy((_features(columns) - self.middle) @ self.whiten)
        away = (
            torch.cdist(some, self.chosen, compute_mode="donot_use_mm_for_euclid_dist") for some in points.split(ROWS)
        )
        return torch.cat([distance.kthvalue(NEIGHBOURS).values for distance in away]).numpy()

    def p_value(self, distance: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """The share of held-out samples at least as far away; below 0.05 for 5 % of familiar samples."""
        n = len(self.usual)
        return (1 + n - np.searchsorted(self.usual, distance)) / (1 + n)


def _features(columns: Arrays) -> Float[np.ndarray, "samples features"]:
    determinant = columns["A_xx"] * columns["A_yy"] - np.square(columns["A_xy"])
    values = [columns["mu_z"], columns["f"] / columns["S"], columns["a"], determinant]
    values += [columns["disagreement"]] if "disagreement" in columns else []
    with np.errstate(divide="ignore", invalid="ignore"):  # of extreme predictions
        return np.nan_to_num(np.log(np.stack(values, axis=-1)), nan=-_FURTHEST).clip(-_FURTHEST, _FURTHEST)
