"""Detections in image files, each predicted by a network, and the predictions as JSON objects."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
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

PER_CENT = (50, 90, 99)  # per cent of the credible intervals of depth
P = np.array([0.5, *(end for level in PER_CENT for end in (0.5 - level / 200, 0.5 + level / 200))])
"""The probabilities of the median and of the ends of the intervals."""
DIGITS = 8
REPEATED = ("file_name", "box", "score", "category_id")  # of the detection
NONE = "none: this model predicts a position alone"


@dataclass(frozen=True, eq=False)
class PredictedBatch:
    """Detections that are predicted together, with their images.

    `predictions` are in the frames of the views (float64), made by `Predictor.predict` from `raw`, the outputs of the
    network; `familiar` is of runs with held-out samples.
    """

    seen: Sequence[tuple[Detection, Image.Image, View]]
    raw: Float[Tensor, "batch *members n_outputs"]
    predictions: Prediction
    familiar: Float[np.ndarray, " batch"] | None = None

    @cached_property
    def out_of_field(self) -> Bool[np.ndarray, " batch"]:
        """Whether the mode lies outside the field of the view."""
        f = [view.camera.f for _, _, view in self.seen]
        cameras = Camera(torch.tensor(f, dtype=torch.float64), self.seen[0][2].camera.S)
        return ~cameras.contains(self.predictions.mode).numpy()

    @cached_property
    def numbers(self) -> dict[str, Float[np.ndarray, "batch ..."]]:
        """What the answers say of the predictions, a row for each detection.

        Lengths are in metres, in the frame of the real camera: x right, y down, z (depth) forward along its axis.
        This is exact for a turned virtual camera too: points and covariance are rotated, and depth quantiles are
        integrated along the axis of the real camera (`quantiles_along`). They are NaN where the mode lies 90 degrees
        or more from it.
        """
        made, R = self.predictions, np.stack([view.camera.R for _, _, view in self.seen])
        mode = made.mode.numpy()
        found = {"mode": _turned_back(mode, R)}
        if made.has_closed_forms:
            found["mean"] = _turned_back(made.mean.numpy(), R)
            found["covariance"] = R.transpose(0, 2, 1) @ made.covariance_matrix.numpy() @ R
            axis, quantiles = R[:, :, 2], np.full((len(R), len(P)), np.nan)
            ahead = (axis * mode).sum(-1) > 0
            quantiles[ahead] = quantiles_along(made[torch.from_numpy(ahead)], axis[ahead], P)
            found["median_depth"] = quantiles[:, 0]
            found["depth_interval"] = quantiles[:, 1:].reshape(-1, len(PER_CENT), 2)
        return found

    @cached_property
    def errors(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """The errors of the tables, which rotating the camera does not change, and the scores of a distribution.

        NaN where the true position is unknown.
        """
        made, known = self.predictions, torch.tensor([one.line.z is not None for one, *_ in self.seen])
        truth = made.mode.clone()  # where it is unknown, a position that every density accepts
        for row in known.nonzero().flatten().tolist():
            detection, _, view = self.seen[row]
            truth[row] = torch.from_numpy(view.camera.to_virtual(np.array(detection.position)))
        errors = {
            "projected_error_mm": MILLIMETRES * projected_error(truth, made.mode),
            "depth_error_mm": MILLIMETRES * depth_error(truth, made.mode),
        }
        if isinstance(made, Density):
            errors |= {"credible_level": made.level(truth), "nll": -made.log_prob(truth)}
        return {name: value.masked_fill(~known, torch.nan).numpy() for name, value in errors.items()}


@dataclass(frozen=True, eq=False)
class Sighting:
    """One detection of a batch."""

    batch: PredictedBatch
    row: int

    @property
    def detection(self) -> Detection:
        """The detection."""
        return self.batch.seen[self.row][0]

    @property
    def image(self) -> Image.Image:
        """Its image."""
        return self.batch.seen[self.row][1]

    @property
    def view(self) -> View:
        """The input of the network."""
        return self.batch.seen[self.row][2]

    @property
    def raw(self) -> Float[Tensor, "*members n_outputs"]:
        """The outputs of the network."""
        return self.batch.raw[self.row]

    @property
    def density(self) -> ProjectedHuber | None:
        """The prediction, unless it is another density or a position alone."""
        made = self.batch.predictions
        return made[self.row] if made.has_closed_forms else None

    @property
    def mode(self) -> Float[np.ndarray, "3"]:
        """The most likely position, or the one that is predicted alone, in the frame of the view, m."""
        mode: np.ndarray = self.batch.predictions.mode[self.row].numpy()
        return mode

    @property
    def familiar(self) -> float | None:
        """Its p-value among held-out samples."""
        return None if self.batch.familiar is None else float(self.batch.familiar[self.row])


def _turned_back(
    points: Float[np.ndarray, "batch 3"], R: Float[np.ndarray, "batch 3 3"]
) -> Float[np.ndarray, "batch 3"]:
    """R^T v: points of the virtual cameras in the frames of the real ones."""
    return (points[:, None] @ R)[:, 0]


def sightings(predictor: Predictor, detections: Sequence[Detection]) -> Iterator[Sighting]:
    """The prediction for each detection, in their order.

    Raises DatasetError, naming the file, for an invalid image, and RunError if a network output is not finite.
    """
    for seen in _batches(predictor, detections):
        f = torch.tensor([view.camera.f for _, _, view in seen], dtype=torch.float64)
        raw = predictor.raw(np.stack([view.image for _, _, view in seen]), f)
        finite = raw.flatten(1).isfinite().all(-1)
        n = int(finite.long().cumprod(0).sum())  # of those before the first that is not
        if n:
            batch = PredictedBatch(
                seen[:n], raw[:n], predictor.predict(raw[:n], f[:n]), predictor.familiar(raw[:n], f[:n])
            )
            yield from (Sighting(batch, row) for row in range(n))
        if n < len(seen):
            raise RunError(
                f"{seen[n][0].where}: the network returns numbers that are not finite; train the run again"
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
    """The numbers of a detection, its region by a `Guarantee`, and its errors if the position is known."""
    batch, row, line = sighting.batch, sighting.row, sighting.detection.line
    named: dict[str, Any] = line.model_dump(include=set(REPEATED), exclude_none=True, mode="json")
    numbers = {name: rounded(values[row]) for name, values in batch.numbers.items()}
    if "depth_interval" in numbers:
        intervals = (None if None in ends else ends for ends in numbers["depth_interval"])
        numbers["depth_interval"] = dict(zip(map(str, PER_CENT), intervals, strict=True))
        named |= numbers | {"uncertainty": uncertainty(temperature)}
        if guarantee:
            camera = sighting.view.camera
            region, facts = guarantee.region(sighting.density, camera.f / camera.S)
            interval = rounded(np.array(region.depth_interval(camera.R[:, 2])))
            named["region"] = facts | {"depth_interval": interval, "volume": rounded(np.array(region.volume))}
    else:
        none = "not reported: no Projected Huber density" if isinstance(batch.predictions, Density) else NONE
        named |= {"position": numbers["mode"], "uncertainty": none}
    if sighting.familiar is not None:
        named["familiar"] = rounded(np.array(sighting.familiar))
    named["out_of_field"] = bool(batch.out_of_field[row])
    errors = {} if line.z is None else batch.errors
    return named | {name: rounded(values[row]) for name, values in errors.items()}


def uncertainty(temperature: Temperature | None) -> str:
    """The origin of the uncertainty: as trained, or recalibrated."""
    if temperature is None:
        return "as trained"
    return f"recalibrated: A / {temperature.projected:.4g}, a / {temperature.depth:.4g}"


def rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Lists of numbers for JSON; None for a number that is not finite."""
    if np.ndim(values):
        return [rounded(value) for value in values]
    return float(f"{values:.{DIGITS}g}") if np.isfinite(values) else None
