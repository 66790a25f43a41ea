"""A prediction spread out into columns: one row a sample, the same for figures, calibration and the record."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch
import torch.distributed as dist
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.data.sources import Known
from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import Columns, coordinates, distribution_columns, draws
from phd_exp.metrics.calibration import CalibrationCurve, calibration_curve
from phd_exp.metrics.calibration_scores import exact_scores
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.metrics.scores import DRAWS, energy_score
from phd_exp.models.heads import Prediction
from phd_exp.records.files import write_atomic

ERRORS = ("projected_error_mm", "depth_error_mm")
OF_A_DISTRIBUTION = ("nll", "depth_precision", "projected_precision")


def quantity_names(prediction: type[Prediction]) -> tuple[str, ...]:
    """What `quantities` measures of a kind of prediction."""
    return ERRORS + (OF_A_DISTRIBUTION if issubclass(prediction, ProjectedHuber) else ())


def quantities(prediction: Prediction, xyz: Tensor) -> Columns:
    """The metrics of a batch, a number a sample: errors in millimetres; of a distribution also `nll`, in nats of the
    density per cubic metre, and the precisions a and |A|.
    """
    values = _errors(prediction, xyz)
    if isinstance(prediction, ProjectedHuber):
        values["nll"] = -prediction.log_prob(xyz)
        values["depth_precision"] = prediction.a
        values["projected_precision"] = prediction.log_det_A.exp()
    return values


def _errors(prediction: Prediction, xyz: Tensor) -> Columns:
    estimate = prediction.mode
    return {
        "projected_error_mm": MILLIMETRES * projected_error(xyz, estimate),
        "depth_error_mm": MILLIMETRES * depth_error(xyz, estimate),
    }


@torch.no_grad()
def columns(prediction: Prediction, batch: Batch) -> Columns:
    """A batch as a table: truth, estimate and its errors; of a distribution parameters, moments and scores too.

    Positions, `depth_crps` and `energy_score` are in metres, in the camera frame; see `distribution_columns`.
    """
    table = {"row": batch.row} | coordinates("", batch.xyz) | coordinates("mode_", prediction.mode)
    table |= _errors(prediction, batch.xyz)
    if isinstance(prediction, ProjectedHuber):
        table |= distribution_columns(prediction, batch.xyz)
        # seeded by the sample: the score depends neither on the epoch nor on what ran before
        drawn = draws(prediction, DRAWS, seed=int(batch.row[0]))
        table["energy_score"] = energy_score(drawn, batch.xyz)
    return {name: column.double().cpu() for name, column in table.items()}


def joined(parts: Sequence[Columns]) -> Columns:
    """The rows of several batches, one after the other."""
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def gathered(table: Columns) -> Columns:
    """The rows of all processes that train together, in the order of the data set; each of them has to call this."""
    if not dist.is_initialized():
        return table
    tables: list[Columns] = [{} for _ in range(dist.get_world_size())]
    dist.all_gather_object(tables, table)
    whole = joined(tables)
    order = whole["row"].argsort()
    return {name: column[order] for name, column in whole.items()}


def calibration_curves(table: Columns, window: int) -> dict[str, CalibrationCurve]:
    """The paper's two curves: of the depth, and of the projected position."""
    return {
        name: calibration_curve(table[f"{name}_variance"], table[f"{name}_squared_error"], window)
        for name in ("depth", "projected")
    }


def summary(table: Columns) -> dict[str, float]:
    """The final numbers of a run, by their metric keys: means over the rows, and scores of calibration."""
    if "a" not in table:
        return {f"test/{name}": float(table[name].mean()) for name in ERRORS}
    means = {
        name: table["a" if name == "depth_precision" else name].mean() for name in ERRORS + OF_A_DISTRIBUTION
    }
    scores = {f"calibration/{name}": score for name, score in exact_scores(table).items()}
    return {f"test/{name}": float(value) for name, value in (means | scores).items()}


def write_parquet(file: Path, table: Columns, known: Known, said: Mapping[str, str] | None = None) -> None:
    """Write the columns beside what is known of each sample, in the order of the data set.

    What is `said` of the table as a whole goes into the metadata of its schema.
    """
    order = table["row"].argsort()
    arrays = {name: pa.array(values) for name, values in known.items()}
    arrays |= {name: pa.array(column[order].numpy()) for name, column in table.items() if name != "row"}
    buffer = io.BytesIO()
    pq.write_table(pa.table(arrays, metadata=dict(said or {})), buffer)
    write_atomic(file, buffer.getvalue())
