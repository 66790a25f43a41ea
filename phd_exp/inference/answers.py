"""Detections in image files, each predicted by a network, and the predictions as JSON objects."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from phd_exp.data.cache import DECODERS, LARGEST_AT_ONCE
from phd_exp.data.crops import read_image, true_position
from phd_exp.distributions import Density, ProjectedHuber, Temperature
from phd_exp.distributions.along import quantiles_along
from phd_exp.geometry.camera import Camera
from phd_exp.inference.predictor import PredictedViews, Predictor
from phd_exp.inference.views import View
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.models.trained import BATCH
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError, UserError
from phd_exp.records.images import pillow_warnings

if TYPE_CHECKING:  # imports of pyarrow
    from phd_exp.evaluation.conformal import Guarantee

Item = TypeVar("Item")

PER_CENT = (50, 90, 99)  # per cent of the credible intervals of depth
P = np.array([0.5, *(end for level in PER_CENT for end in (0.5 - level / 200, 0.5 + level / 200))])
"""The probabilities of the median and of the ends of the intervals."""
DIGITS = 8
REPEATED = ("file_name", "box", "score", "category_id")  # of the detection
NONE = "none: this model predicts a position alone"


@dataclass(frozen=True, eq=False)
class Answers:
    """Detections that are predicted together, with what their answers have in common.

    Args:
        detections: a row for each view of `found`.
        found: the predictions, in the frames of the views.
        guarantee: gives each prediction a region.
    """

    detections: Sequence[Detection]
    found: PredictedViews
    guarantee: "Guarantee | None" = None

    @cached_property
    def R(self) -> Float[np.ndarray, "batch 3 3"]:
        """The rotations from the frames of the real cameras to those of the views."""
        return np.stack([view.camera.R for view in self.found.views])

    @cached_property
    def numbers(self) -> dict[str, Float[np.ndarray, "batch ..."]]:
        """What the answers say of the predictions, a row for each detection.

        Lengths are in metres, in the frame of the real camera: x right, y down, z (depth) forward along its axis.
        This is exact for a turned virtual camera too: points and covariance are rotated, and depth quantiles are
        integrated along the axis of the real camera (`quantiles_along`). They are NaN where the mode lies 90 degrees
        or more from it.
        """
        made, R = self.found.predictions, self.R
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
    def truth(self) -> Float[np.ndarray, "batch 3"]:
        """The true positions in the frames of the views, m; NaN where they are unknown."""
        return np.stack(
            [
                np.full(3, np.nan) if one.line.z is None else view.camera.to_virtual(np.array(one.position))
                for one, view in zip(self.detections, self.found.views, strict=True)
            ]
        )

    @cached_property
    def lines(self) -> list[dict[str, Any]]:
        """The numbers of each detection for JSON, a baseline's position alone.

        With the region of a guarantee, `familiar` if it is known, and errors if the true position is known.
        """
        columns, made = {name: rounded(values) for name, values in self.numbers.items()}, self.found.predictions
        if made.has_closed_forms:
            columns["depth_interval"] = [
                {str(level): None if None in ends else ends for level, ends in zip(PER_CENT, intervals, strict=True)}
                for intervals in columns["depth_interval"]
            ]
        else:
            columns = {"position": columns["mode"]}
        columns |= {"uncertainty": [self._uncertainty()] * len(self.R), "warnings": self.found.warnings}
        cameras = Camera(self.found.f, float(self.found.predictor.side))
        if self.guarantee and made.has_closed_forms:
            columns["region"] = self._regions(self.guarantee, made, cameras)
        if self.found.familiar is not None:
            columns["familiar"] = rounded(np.array(self.found.familiar))
        columns["out_of_field"] = (~cameras.contains(made.mode)).tolist()
        rows, known = _rows(columns), np.isfinite(self.truth[:, 2])
        if known.any():
            errors = _rows({name: rounded(values) for name, values in self._errors().items()})
            rows = [row | (more if is_known else {}) for row, more, is_known in zip(rows, errors, known, strict=True)]
        return rows

    def _uncertainty(self) -> str:
        made = self.found.predictions
        if made.has_closed_forms:
            return uncertainty(self.found.predictor.temperature)
        return "not reported: no Projected Huber density" if isinstance(made, Density) else NONE

    def _errors(self) -> dict[str, Float[np.ndarray, " batch"]]:
        """The errors of the tables, which rotating the camera does not change, and the scores of a distribution.

        They mean nothing where the true position is unknown: it is replaced by one that every density accepts.
        """
        made, truth = self.found.predictions, torch.from_numpy(self.truth)
        truth = torch.where(truth.isnan(), made.mode, truth)
        errors = {
            "projected_error_mm": MILLIMETRES * projected_error(truth, made.mode),
            "depth_error_mm": MILLIMETRES * depth_error(truth, made.mode),
        }
        if isinstance(made, Density):
            errors |= {"credible_level": made.level(truth), "nll": -made.log_prob(truth)}
        return {name: value.numpy() for name, value in errors.items()}

    def _regions(self, guarantee: "Guarantee", predictions: ProjectedHuber, cameras: Camera) -> list[dict[str, Any]]:
        regions, facts = guarantee.regions(predictions, (cameras.f / cameras.S).numpy())
        extent = np.stack(regions.depth_interval(self.R[:, :, 2]), axis=-1)
        numbers = _rows({"depth_interval": rounded(extent), "volume": rounded(regions.volume)})
        return [{**one, **more} for one, more in zip(facts, numbers, strict=True)]


@dataclass(frozen=True, eq=False)
class Sighting:
    """One detection with its image, and its row of answers."""

    detection: Detection
    image: Image.Image
    answers: Answers
    row: int

    @property
    def view(self) -> View:
        """The input of the network."""
        return self.answers.found.views[self.row]

    @property
    def raw(self) -> Float[Tensor, "*members n_outputs"]:
        """The outputs of the network."""
        return self.answers.found.raw[self.row]

    @property
    def density(self) -> ProjectedHuber | None:
        """The prediction, unless it is another density or a position alone."""
        made = self.answers.found.predictions
        return made[self.row] if made.has_closed_forms else None

    @property
    def mode(self) -> Float[np.ndarray, "3"]:
        """The most likely position, or the one that is predicted alone, in the frame of the view, m."""
        mode: np.ndarray = self.answers.found.predictions.mode[self.row].numpy()
        return mode

    @property
    def truth(self) -> Float[np.ndarray, "3"] | None:
        """The true position in the frame of the view, m, if it is known."""
        return None if self.detection.line.z is None else self.answers.truth[self.row]

    @property
    def truth_ahead(self) -> Float[np.ndarray, "3"] | None:
        """The true position, if it is known and the view contains its direction."""
        return self.truth if self.truth is not None and self.truth[2] > 0 else None

    @property
    def numbers(self) -> dict[str, Float[np.ndarray, "..."]]:
        """Its row of `Answers.numbers`."""
        return {name: values[self.row] for name, values in self.answers.numbers.items()}

    @property
    def familiar(self) -> float | None:
        """Its p-value among held-out samples."""
        return None if self.answers.found.familiar is None else self.answers.found.familiar[self.row]

    @property
    def warnings(self) -> list[str]:
        """What is beyond the training, see `Ranges.warnings`."""
        return self.answers.found.warnings[self.row]

    @property
    def line(self) -> dict[str, Any]:
        """The keys of the detection and its row of `Answers.lines`, for JSON."""
        named = self.detection.line.model_dump(include=set(REPEATED), exclude_none=True, mode="json")
        return named | self.answers.lines[self.row]


def _turned_back(
    points: Float[np.ndarray, "batch 3"], R: Float[np.ndarray, "batch 3 3"]
) -> Float[np.ndarray, "batch 3"]:
    """R^T v: points of the virtual cameras in the frames of the real ones."""
    return (points[:, None] @ R)[:, 0]


def _rows(columns: dict[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """The rows of columns of equal length."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


Seen = tuple[Detection, Image.Image, View]


def sightings(
    predictor: Predictor, detections: Iterable[Detection], guarantee: "Guarantee | None" = None
) -> Iterator[Sighting]:
    """The prediction for each detection, in their order, with the regions of a guarantee.

    Raises DatasetError, naming the file, for an invalid image, and RunError if a network output is not finite.
    """
    for seen in _batches(predictor, detections):
        each, images, views = zip(*seen, strict=True)
        answers = Answers(each, predictor.predicted(views), guarantee)
        yield from (
            Sighting(one, image, answers, row) for row, (one, image) in enumerate(zip(each, images, strict=True))
        )


def _batches(predictor: Predictor, detections: Iterable[Detection]) -> Iterator[list[Seen]]:
    """Detections with image and view; consecutive detections in one file share its image.

    A batch ends with the file that completes `BATCH` detections or exceeds `LARGEST_AT_ONCE` pixels, and before the
    first error. As many files as torch has threads are decoded at the same time.
    """
    threads = min(DECODERS, torch.get_num_threads())
    files = _with_error(together(detections, lambda one: one.file, BATCH))
    batch: list[Seen] = []
    with ThreadPoolExecutor(threads) as pool:
        while some := list(islice(files, threads)):
            with pillow_warnings():
                decoded = list(pool.map(partial(_seen, predictor), some))
            for found in decoded:
                batch += [one for one in found if not isinstance(one, UserError)]
                if found and isinstance(found[-1], UserError):
                    if batch:
                        yield batch  # the predictions before the invalid image are not lost
                    raise found[-1]
            pixels = sum({id(image): image.width * image.height for _, image, _ in batch}.values())
            if len(batch) >= BATCH or pixels > LARGEST_AT_ONCE:
                yield batch
                batch = []
        if batch:
            yield batch


def together(items: Iterable[Item], key: Callable[[Item], object], most: float = math.inf) -> Iterator[list[Item]]:
    """Consecutive items with the same key, at most so many; also the last ones before a UserError."""
    same: list[Item] = []
    for item in _with_error(items):
        if same and (isinstance(item, UserError) or key(item) != key(same[0]) or len(same) == most):
            yield same
            same = []
        if isinstance(item, UserError):
            raise item
        same.append(item)
    if same:
        yield same


def _with_error(items: Iterable[Item]) -> Iterator[Item | UserError]:
    """The items, and the UserError with which they end, if they do."""
    try:
        yield from items
    except UserError as error:
        yield error


def _seen(predictor: Predictor, detections: list[Detection] | UserError) -> list[Seen | UserError]:
    """The detections in one file, those before the first that is invalid, and its error."""
    if isinstance(detections, UserError):
        return [detections]
    found: list[Seen | UserError] = []
    try:
        image = read_image(detections[0].file, detections[0].content)
        for detection in detections:
            K, lens = detection.optics(*image.size)
            box = detection.box(*image.size) if detection.line.box else None
            view = predictor.view(image, K, box, lens, detection.where)
            if detection.line.z is not None:
                true_position(detection, image.size, view.camera, predictor.widest)
            found.append((detection, image, view))
    except DatasetError as error:
        found.append(error)
    return found


def uncertainty(temperature: Temperature | None) -> str:
    """The origin of the uncertainty: as trained, or recalibrated."""
    return "as trained" if temperature is None else f"recalibrated: {temperature}"


def rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Lists of numbers for JSON; None for a number that is not finite."""
    return _rounded(np.asarray(values).tolist())


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
