"""Ensembles from the records of single runs: the closest distribution to the mixture of their predictions."""

from collections.abc import Sequence

import numpy as np
import torch

from phd_exp.distributions import Mixture
from phd_exp.distributions.columns import PARAMETERS, distribution_columns, from_columns
from phd_exp.evaluation.parquet import Columns, require_columns, stacked
from phd_exp.evaluation.predictions import XYZ
from phd_exp.records.errors import RunError


def ensemble_table(tables: Sequence[Columns]) -> Columns:
    """The scores and parameters of the ensemble's closest distributions, and the members' `disagreement` (nats).

    Raises RunError if a column is missing, or the tables are of different samples.
    """
    for table in tables:
        require_columns((*PARAMETERS, *XYZ), table)
        names = [name for name in (*XYZ, "file_name") if name in table]
        if not all(name in tables[0] and np.array_equal(table[name], tables[0][name]) for name in names):
            raise RunError("predictions: those of an ensemble are of different samples; train on one data set")
    columns = {name: torch.tensor(np.stack([table[name] for table in tables], axis=-1)) for name in PARAMETERS}
    mixture = Mixture(from_columns(columns))
    scores = distribution_columns(mixture.closest, stacked(tables[0], XYZ)) | {"disagreement": mixture.disagreement}
    kept = {name: tables[0][name] for name in (*XYZ, "f", "S") if name in tables[0]}
    return kept | {name: column.numpy() for name, column in scores.items()}
