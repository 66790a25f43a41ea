"""Detections in image files, each predicted by a network, and the predictions as JSON objects."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from phd_exp.data.cache import LARGEST_AT_ONCE
from phd_exp.data.crops import cut, facing, read_image
from phd_exp.distributions import Density, ProjectedHuber, Temperature
from phd_exp.distributions.along import quantiles_along
from phd_exp.geometry.camera import Camera
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.inference.views import View
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.models.heads import Prediction
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError, RunError
from phd_exp.records.images import content_of, pillow_warnings

LEVELS = (50, 90, 99)  # per cent of the credible intervals of depth
DIGITS = 8
REPEATED = ("file_name", "box", "score", "category_id")  # of the detection
NONE = "none: this model predicts a position alone"


@dataclass(frozen=True, eq=False)
class Sighting:
    """A detection, its image, and its prediction in the frame of the view's virtual camera (float64).

    `raw` holds the outputs of the network, from which `Predictor.predict` makes the prediction; `familiar` is of runs
    with held-out samples.
    """

    detection: Detection
    image: Image.Image
    view: View
    raw: Float[Tensor, "*members n_outputs"]
    prediction: Prediction
    familiar: float | None = None


def sightings(predictor: Predictor, detections: Sequence[Detection]) -> Iterator[Sighting]:
    """The prediction for each detection, in their order.

    Raises DatasetError, naming the file, for an invalid image, and RunError if a network output is not finite.
    """
    for batch in _batches(predictor, detections):
        f = torch.tensor([view.camera.f for _, _, view in batch], dtype=torch.float64)
        raw = predictor.raw(np.stack([view.image for _, _, view in batch]), f)
        # a batch takes an ensemble less time than its images one by one
        made = predictor.predict(raw, f) if predictor.is_ensemble else None
        familiar = predictor.familiar(raw, f)
        for row, (detection, image, view) in enumerate(batch):
            if not bool(raw[row].isfinite().all()):
                raise RunError(
                    f"{detection.where}: the network returns numbers that are not finite; train the run again"
                )
            prediction = made[row] if made and made.has_closed_forms else predictor.predict(raw[row], f[row])
            yield Sighting(
                detection, image, view, raw[row], prediction, None if familiar is None else float(familiar[row])
            )


def _batches(
    predictor: Predictor, detections: Sequence[Detection]
) -> Iterator[list[tuple[Detection, Image.Image, View]]]:
    """Detections with image and view; consecutive detections in one file share its image.

    A batch ends at `BATCH` detections, or when its images exceed `LARGEST_AT_ONCE` pixels.
    """
    batch: list[tuple[Detection, Image.Image, View]] = []
    pixels = 0
    for detection in detections:
        try:
            if batch and batch[-1][0].file == detection.file:
                image = batch[-1][1]
            else:
                with pillow_warnings():
                    image = read_image(detection.file, content_of(detection.file))
                pixels += image.width * image.height
            camera = facing(detection, image.size, predictor.side, predictor.largest_f)
        except DatasetError:
            if batch:
                yield batch  # the predictions before the invalid image are not lost
            raise
        batch.append((detection, image, View(cut(image, camera), camera)))
        if len(batch) == BATCH or pixels > LARGEST_AT_ONCE:
            yield batch
            batch, pixels = [], 0
    if batch:
        yield batch


def answer(sighting: Sighting, temperature: Temperature | None, guarantee: Any = None) -> dict[str, Any]:
    """The prediction for a detection, its region by a `Guarantee`, and its errors if the position is known.

    Lengths are in metres, in the frame of the real camera: x right, y down, z (depth) forward along its axis. This is
    exact for a turned virtual camera too: points and covariance are rotated, and depth quantiles are integrated along
    the axis of the real camera (`quantiles_along`).
    """
    prediction, view, line = sighting.prediction, sighting.view, sighting.detection.line
    named: dict[str, Any] = line.model_dump(include=set(REPEATED), exclude_none=True, mode="json")
    if prediction.has_closed_forms:
        named |= _distribution(prediction, view) | {"uncertainty": uncertainty(temperature)}
        if guarantee:
            region, facts = guarantee.region(prediction, view.camera.f / view.camera.S)
            interval = rounded(np.array(region.depth_interval(view.camera.R[:, 2])))
            named["region"] = facts | {"depth_interval": interval, "volume": rounded(np.array(region.volume))}
    else:
        position = view.camera.to_real(prediction.mode.numpy())
        none = "not reported: no Projected Huber density" if isinstance(prediction, Density) else NONE
        named |= {"position": rounded(position), "uncertainty": none}
    if sighting.familiar is not None:
        named["familiar"] = rounded(np.array(sighting.familiar))
    camera = Camera(torch.tensor(view.camera.f, dtype=torch.float64), view.camera.S)
    named["out_of_field"] = not bool(camera.contains(prediction.mode))
    return named | (_errors(sighting) if line.z is not None else {})


def _distribution(distribution: ProjectedHuber, view: View) -> dict[str, Any]:
    """Its numbers; those of depth are None if the mode lies 90 degrees or more from the real camera's axis."""
    R, axis = view.camera.R, view.camera.R[:, 2]
    median, intervals = None, [None] * len(LEVELS)
    if axis @ distribution.mode.numpy() > 0:
        tails = [(1 - level / 100) / 2 for level in LEVELS]
        p = [0.5, *(end for tail in tails for end in (tail, 1 - tail))]
        z = quantiles_along(distribution, axis, np.array(p))
        median, intervals = rounded(z[0]), rounded(z[1:].reshape(-1, 2))
    return {
        "mode": rounded(view.camera.to_real(distribution.mode.numpy())),
        "mean": rounded(view.camera.to_real(distribution.mean.numpy())),
        "covariance": rounded(R.T @ distribution.covariance_matrix.numpy() @ R),
        "median_depth": median,
        "depth_interval": dict(zip(map(str, LEVELS), intervals, strict=True)),
    }


def uncertainty(temperature: Temperature | None) -> str:
    """The origin of the uncertainty: as trained, or recalibrated."""
    if temperature is None:
        return "as trained"
    return f"recalibrated: A / {temperature.projected:.4g}, a / {temperature.depth:.4g}"


def _errors(sighting: Sighting) -> dict[str, Any]:
    """The errors of the tables, which rotating the camera does not change, and the scores of a distribution."""
    prediction = sighting.prediction
    truth = torch.from_numpy(sighting.view.camera.to_virtual(np.array(sighting.detection.position)))
    errors = {
        "projected_error_mm": MILLIMETRES * projected_error(truth, prediction.mode),
        "depth_error_mm": MILLIMETRES * depth_error(truth, prediction.mode),
    }
    if isinstance(prediction, Density):
        errors |= {"credible_level": prediction.level(truth), "nll": -prediction.log_prob(truth)}
    return {name: rounded(value.numpy()) for name, value in errors.items()}


def rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Lists of numbers for JSON; None for a number that is not finite."""
    if np.ndim(values):
        return [rounded(value) for value in values]
    return float(f"{values:.{DIGITS}g}") if np.isfinite(values) else None
