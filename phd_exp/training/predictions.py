"""Predictions as columns, one row per sample, for logged metrics, calibration curves and the record."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.data.sources import Known
from phd_exp.distributions import Density
from phd_exp.distributions.columns import Columns, coordinates, distribution_columns
from phd_exp.evaluation.volumes import drawn_columns
from phd_exp.metrics.calibration import CalibrationCurve, calibration_curve
from phd_exp.metrics.calibration_scores import exact_scores
from phd_exp.metrics.errors import MILLIMETRES, depth_error, distance_error, projected_error
from phd_exp.models.heads import Prediction
from phd_exp.models.trained import BATCH, TrainedNetwork
from phd_exp.records.files import write_atomic
from phd_exp.training.cameras import f_factor

MEANS = {
    "loss": "loss",
    "projected_error_mm": "projected_error_mm",
    "depth_error_mm": "depth_error_mm",
    "ale_m": "ale_m",
    "relative_error": "relative_error",
    "nll": "nll",
    "a": "depth_precision",
    "projected_precision": "projected_precision",
}
"""Column -> the metric that is its mean."""
TRAINING = ("loss", "projected_error_mm", "depth_error_mm", "nll", "depth_precision", "projected_precision")
"""The metrics of training batches, of those that the model has."""
UNRECORDED = ("row", "loss", "f_factor")


def training_columns(
    prediction: Prediction, xyz: Float[Tensor, "batch 3"], nll: Float[Tensor, " batch"] | None
) -> Columns:
    """The metrics of a training batch: errors in millimetres; of a distribution also its NLL (nats; computed unless
    given), and of a Projected Huber density the precisions a and |A|.
    """
    table = _errors(prediction, xyz)
    if isinstance(prediction, Density):
        table["nll"] = -prediction.log_prob(xyz) if nll is None else nll
    if prediction.has_closed_forms:
        table["depth_precision"] = prediction.a
        table["projected_precision"] = prediction.log_det_A.exp()
    return table


def _errors(prediction: Prediction, xyz: Tensor) -> Columns:
    estimate = prediction.mode
    return {
        "projected_error_mm": MILLIMETRES * projected_error(xyz, estimate),
        "depth_error_mm": MILLIMETRES * depth_error(xyz, estimate),
    }


@torch.no_grad()
def columns(prediction: Prediction, batch: Batch, factor: Float[Tensor, " batch"] | float = 1.0) -> Columns:
    """A batch as a table: camera, truth, estimate, errors; of a distribution also parameters, moments and scores.

    Positions, `depth_crps` and `energy_score` are in metres, in the camera frame; see `distribution_columns`. `f` is
    the focal length that the model received: `factor` times that of the batch.
    """
    table = {"row": batch.row, "f": factor * batch.f, "S": torch.full_like(batch.f, batch.S)}
    table["f_factor"] = factor * torch.ones_like(batch.f)
    table |= coordinates("", batch.xyz) | coordinates("mode_", prediction.mode)
    table |= _errors(prediction, batch.xyz)
    table["ale_m"] = distance_error(batch.xyz, prediction.mode)
    table["relative_error"] = 100 * table["ale_m"] / batch.xyz.norm(dim=-1)
    if isinstance(prediction, Density):
        table |= distribution_columns(prediction, batch.xyz)
        # seeded by the sample, so that the scores do not depend on the epoch
        table |= drawn_columns(prediction, batch.xyz, seed=int(batch.row[0]))
    return {name: column.double() for name, column in table.items()}


def predicted(
    network: TrainedNetwork,
    samples: Batch,
    f_error: float,
    factor: float = 1.0,
    change: Callable[[Tensor], Tensor] = lambda image: image,
) -> Columns:
    """The table of samples that a trained network predicts; of an ensemble also the `disagreement` of its members.

    `change` is applied to the images, and the focal lengths have the errors of evaluations and a further factor.
    """
    parts = []
    for rows in torch.arange(len(samples)).split(BATCH):
        batch = samples.select(rows)
        received = factor * f_factor(batch.row, f_error)
        f = received * batch.f
        raw = network.raw(change(batch.image), f)
        found = columns(network.predict(raw, f), batch, received)
        if network.is_ensemble:
            found["disagreement"] = network.members(raw, f).disagreement
        parts.append(found)
    return joined(parts)


def joined(parts: Sequence[Columns]) -> Columns:
    """Tables one below the other."""
    return {name: torch.cat([part[name] for part in parts]).cpu() for name in parts[0]}


def calibration_curves(table: Columns, window: int) -> dict[str, CalibrationCurve]:
    """The paper's two curves, for depth and projected position; a point estimate has none."""
    return {
        name: calibration_curve(table[f"{name}_variance"], table[f"{name}_squared_error"], window)
        for name in ("depth", "projected")
        if f"{name}_variance" in table
    }


def summary(table: Columns, part: str = "test") -> dict[str, float]:
    """Metrics of the evaluation of a part of the samples: means over the rows, and calibration scores."""
    means = {metric: float(table[column].mean()) for column, metric in MEANS.items() if column in table}
    scores = exact_scores(table) if "level" in table else {}
    return {f"{part}/{name}": value for name, value in means.items()} | {
        f"{part}/calibration/{name}": score for name, score in scores.items()
    }


def write_parquet(file: Path, table: Columns, known: Known, said: Mapping[str, str] | None = None) -> None:
    """Write the columns and the metadata of their samples, in the order of the data set.

    The metadata may have f and S of the stored images; f is then recorded in their pixels, as the model received it.
    `said` goes into the metadata of the schema.
    """
    rows = table["row"].long().tolist()
    arrays = {name: pa.array([values[row] for row in rows]) for name, values in known.items()}
    if "f" in known:
        arrays["f"] = pa.array(table["f_factor"].numpy() * [known["f"][row] for row in rows])
    arrays |= {name: pa.array(column.numpy()) for name, column in table.items() if name not in (*UNRECORDED, *known)}
    buffer = io.BytesIO()
    pq.write_table(pa.table(arrays, metadata=dict(said or {})), buffer)
    write_atomic(file, buffer.getvalue())
