"""A prediction spread out into columns: one row a sample, the same for figures, calibration and the record."""

import io
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import torch
import torch.distributed as dist
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.data.sources import Known
from phd_exp.distributions import ProjectedHuber
from phd_exp.metrics.calibration import CalibrationCurve, calibration_curve
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.models.heads import Prediction
from phd_exp.records.files import write_atomic

Columns = dict[str, Tensor]
"""Name -> one number a sample."""

ERRORS = ("projected_error_mm", "depth_error_mm")
OF_A_DISTRIBUTION = ("nll", "depth_precision", "projected_precision")


def quantity_names(prediction: type[Prediction]) -> tuple[str, ...]:
    """What `quantities` measures of a kind of prediction."""
    return ERRORS + (OF_A_DISTRIBUTION if issubclass(prediction, ProjectedHuber) else ())


def quantities(prediction: Prediction, xyz: Tensor) -> Columns:
    """The metrics of a batch, a number a sample: errors in millimetres; of a distribution also `nll`, in nats of the
    density per cubic metre, and the precisions a and |A|.
    """
    estimate = prediction.mode
    values = {
        "projected_error_mm": MILLIMETRES * projected_error(xyz, estimate),
        "depth_error_mm": MILLIMETRES * depth_error(xyz, estimate),
    }
    if isinstance(prediction, ProjectedHuber):
        values["nll"] = -prediction.log_prob(xyz)
        values["depth_precision"] = prediction.a
        values["projected_precision"] = prediction.log_det_A.exp()
    return values


@torch.no_grad()
def columns(prediction: Prediction, batch: Batch) -> Columns:
    """A batch as a table: truth, estimate and `quantities`; for a distribution its parameters and moments too.

    Positions are metres in the camera frame, variances m^2 (depth) and without unit (projected: of x/z and y/z).
    """
    table = {"row": batch.row} | _coordinates("", batch.xyz) | _coordinates("mode_", prediction.mode)
    table |= quantities(prediction, batch.xyz)
    if isinstance(prediction, ProjectedHuber):
        table |= _distribution_columns(prediction, batch.xyz)
    return {name: column.double().cpu() for name, column in table.items()}


def _distribution_columns(prediction: ProjectedHuber, xyz: Tensor) -> Columns:
    A, mu_xy, mean = prediction.A, prediction.mu_xy, prediction.mean
    off_centre = xyz[:, :2] / xyz[:, 2:] - mu_xy
    return {
        **_coordinates("mean_", mean),
        "median_z": prediction.depth_median,
        "mu_x": mu_xy[:, 0],
        "mu_y": mu_xy[:, 1],
        "mu_z": prediction.mu_z,
        "A_xx": A[:, 0, 0],
        "A_xy": A[:, 0, 1],
        "A_yy": A[:, 1, 1],
        "a": prediction.a,
        "depth_variance": prediction.depth_variance,
        "depth_squared_error": (xyz[:, 2] - mean[:, 2]).square(),
        "projected_variance": prediction.projected_covariance.diagonal(dim1=-2, dim2=-1).sum(-1),
        "projected_squared_error": off_centre.square().sum(-1),
        "level": prediction.level(xyz),
    }


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
    """The final numbers of a run, by their metric keys: means over the rows."""
    return {f"test/{name}": float(table[name].mean()) for name in ERRORS + OF_A_DISTRIBUTION if name in table}


def write_parquet(file: Path, table: Columns, known: Known) -> None:
    """Write the columns beside what is known of each sample, in the order of the data set."""
    order = table["row"].argsort()
    arrays = {name: pa.array(values) for name, values in known.items()}
    arrays |= {name: pa.array(column[order].numpy()) for name, column in table.items() if name != "row"}
    buffer = io.BytesIO()
    pq.write_table(pa.table(arrays), buffer)
    write_atomic(file, buffer.getvalue())


def _coordinates(prefix: str, xyz: Tensor) -> Columns:
    return {f"{prefix}{axis}": xyz[:, place] for place, axis in enumerate("xyz")}
