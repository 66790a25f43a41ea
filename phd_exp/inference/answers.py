"""Detections in image files, each predicted by a network, and the predictions as JSON objects."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from phd_exp.data.cache import DECODERS, LARGEST_AT_ONCE
from phd_exp.data.crops import cut, read_image, true_position
from phd_exp.distributions import Density, ProjectedHuber, Temperature
from phd_exp.distributions.along import quantiles_along
from phd_exp.geometry.camera import Camera
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.inference.ranges import UNKNOWN, Ranges
from phd_exp.inference.views import View
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error
from phd_exp.models.heads import Prediction
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError, RunError, UserError
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
class PredictedBatch:
    """Detections that are predicted together, with their images.

    `predictions` are in the frames of the views (float64), made by `Predictor.predict` from `raw`, the outputs of the
    network; `familiar` is of runs with held-out samples; a `guarantee` gives each prediction a region; `ranges` of
    the training give warnings.
    """

    seen: Sequence[tuple[Detection, Image.Image, View]]
    raw: Float[Tensor, "batch *members n_outputs"]
    predictions: Prediction
    familiar: Float[np.ndarray, " batch"] | None = None
    guarantee: "Guarantee | None" = None
    ranges: Ranges = UNKNOWN

    @property
    def cameras(self) -> Camera:
        """The cameras of the views."""
        f = [view.camera.f for _, _, view in self.seen]
        return Camera(torch.tensor(f, dtype=torch.float64), self.seen[0][2].camera.S)

    @property
    def R(self) -> Float[np.ndarray, "batch 3 3"]:
        """The rotations from the frames of the real cameras to those of the views."""
        return np.stack([view.camera.R for _, _, view in self.seen])

    @cached_property
    def out_of_field(self) -> Bool[np.ndarray, " batch"]:
        """Whether the mode lies outside the field of the view."""
        return ~self.cameras.contains(self.predictions.mode).numpy()

    @cached_property
    def numbers(self) -> dict[str, Float[np.ndarray, "batch ..."]]:
        """What the answers say of the predictions, a row for each detection.

        Lengths are in metres, in the frame of the real camera: x right, y down, z (depth) forward along its axis.
        This is exact for a turned virtual camera too: points and covariance are rotated, and depth quantiles are
        integrated along the axis of the real camera (`quantiles_along`). They are NaN where the mode lies 90 degrees
        or more from it.
        """
        made, R = self.predictions, self.R
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

    @cached_property
    def positions(self) -> list[dict[str, Any]]:
        """The `numbers` of each detection, for JSON; a baseline has its position alone."""
        columns = {name: rounded(values) for name, values in self.numbers.items()}
        if "depth_interval" in columns:
            columns["depth_interval"] = [
                {str(level): None if None in ends else ends for level, ends in zip(PER_CENT, intervals, strict=True)}
                for intervals in columns["depth_interval"]
            ]
        else:
            columns = {"position": columns["mode"]}
        return _rows(columns)

    @cached_property
    def scores(self) -> list[dict[str, Any]]:
        """The region of each detection, its familiarity, and its errors if the position is known, for JSON."""
        columns: dict[str, Any] = {}
        if self.guarantee and self.predictions.has_closed_forms:
            columns["region"] = self._regions(self.guarantee, self.predictions)
        if self.familiar is not None:
            columns["familiar"] = rounded(self.familiar)
        found = _rows(columns | {"out_of_field": self.out_of_field.tolist()})
        is_known = [one.line.z is not None for one, *_ in self.seen]
        if not any(is_known):
            return found
        errors = _rows({name: rounded(values) for name, values in self.errors.items()})
        return [row | more if known else row for row, more, known in zip(found, errors, is_known, strict=True)]

    def _regions(self, guarantee: "Guarantee", predictions: ProjectedHuber) -> list[dict[str, Any]]:
        regions, facts = guarantee.regions(predictions, (self.cameras.f / self.cameras.S).numpy())
        extent = np.stack(regions.depth_interval(self.R[:, :, 2]), axis=-1)
        numbers = _rows({"depth_interval": rounded(extent), "volume": rounded(regions.volume)})
        return [{**one, **more} for one, more in zip(facts, numbers, strict=True)]


@dataclass(frozen=True, eq=False)
class Sighting:
    """One detection with its image, the input of the network, and its row of a predicted batch."""

    detection: Detection
    image: Image.Image
    view: View
    batch: PredictedBatch
    row: int

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

    @property
    def warnings(self) -> list[str]:
        """What is beyond the training, see `Ranges.warnings`."""
        size = self.image.size
        return self.batch.ranges.warnings(self.view.camera, self.mode, self.detection.box(*size), size, self.familiar)


def _turned_back(
    points: Float[np.ndarray, "batch 3"], R: Float[np.ndarray, "batch 3 3"]
) -> Float[np.ndarray, "batch 3"]:
    """R^T v: points of the virtual cameras in the frames of the real ones."""
    return (points[:, None] @ R)[:, 0]


def _rows(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """The rows of columns of equal length."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def sightings(
    predictor: Predictor, detections: Iterable[Detection], guarantee: "Guarantee | None" = None
) -> Iterator[Sighting]:
    """The prediction for each detection, in their order, with the regions of a guarantee.

    Raises DatasetError, naming the file, for an invalid image, and RunError if a network output is not finite.
    """
    for seen in _batches(predictor, detections):
        f = torch.tensor([view.camera.f for _, _, view in seen], dtype=torch.float64)
        raw = predictor.raw(np.stack([view.image for _, _, view in seen]), f)
        finite = raw.flatten(1).isfinite().all(-1)
        n = int(finite.long().cumprod(0).sum())  # of those before the first that is not
        if n:
            made = predictor.predict(raw[:n], f[:n])
            familiar = predictor.familiar(raw[:n], f[:n], made)
            batch = PredictedBatch(seen[:n], raw[:n], made, familiar, guarantee, predictor.ranges)
            yield from (Sighting(*one, batch, row) for row, one in enumerate(batch.seen))
        if n < len(seen):
            raise RunError(
                f"{seen[n][0].where}: the network returns numbers that are not finite; train the run again"
            )


Seen = tuple[Detection, Image.Image, View]


def _batches(predictor: Predictor, detections: Iterable[Detection]) -> Iterator[list[Seen]]:
    """Detections with image and view; consecutive detections in one file share its image.

    A batch ends with the file that completes `BATCH` detections or exceeds `LARGEST_AT_ONCE` pixels. As many files as
    torch has threads are decoded at the same time.
    """
    threads = min(DECODERS, torch.get_num_threads())
    files = _with_error(together(detections, lambda one: one.file, BATCH))
    batch: list[Seen] = []
    with ThreadPoolExecutor(threads) as pool:
        while some := list(islice(files, threads)):
            with pillow_warnings():
                seen = list(pool.map(partial(_seen, predictor), some))
            for found, error in seen:
                batch += found
                if error:
                    if batch:
                        yield batch  # the predictions before the invalid image are not lost
                    raise error
            pixels = sum({id(image): image.width * image.height for _, image, _ in batch}.values())
            if len(batch) >= BATCH or pixels > LARGEST_AT_ONCE:
                yield batch
                batch = []
        if batch:
            yield batch


def together(items: Iterable[Item], key: Callable[[Item], object], most: float = math.inf) -> Iterator[list[Item]]:
    """Consecutive items with the same key, at most so many; also the last ones before a UserError."""
    same: list[Item] = []
    try:
        for item in items:
            if same and (key(item) != key(same[0]) or len(same) == most):
                yield same
                same = []
            same.append(item)
    except UserError:
        if same:
            yield same
        raise
    if same:
        yield same


def _with_error(items: Iterable[Item]) -> Iterator[Item | UserError]:
    """The items, and the UserError with which they end, if they do."""
    try:
        yield from items
    except UserError as error:
        yield error


def _seen(predictor: Predictor, detections: list[Detection] | UserError) -> tuple[list[Seen], UserError | None]:
    """The detections in one file, those before the first that is invalid, and its error."""
    if isinstance(detections, UserError):
        return [], detections
    found: list[Seen] = []
    try:
        image = read_image(detections[0].file, detections[0].content)
        for detection in detections:
            camera = _facing(predictor, detection, image.size)
            if detection.line.z is not None:
                true_position(detection, image.size, camera, predictor.widest)
            found.append((detection, image, View(cut(image, camera), camera)))
    except DatasetError as error:
        return found, error
    return found, None


def _facing(predictor: Predictor, detection: Detection, size: tuple[int, int]) -> VirtualCamera:
    """The camera of the view of a detection. Raises DatasetError as `data.crops.facing`."""
    box = detection.box(*size)
    K, lens = detection.optics(*size)
    try:
        return predictor.virtual_camera(K, size, box if detection.line.box else None, lens)
    except ValueError as error:
        raise DatasetError(f"{detection.where}: {error}") from None


def answer(sighting: Sighting, temperature: Temperature | None) -> dict[str, Any]:
    """The numbers of a detection for JSON, its region, and its errors if the position is known."""
    batch, row, made = sighting.batch, sighting.row, sighting.batch.predictions
    named: dict[str, Any] = sighting.detection.line.model_dump(include=set(REPEATED), exclude_none=True, mode="json")
    if made.has_closed_forms:
        origin = uncertainty(temperature)
    else:
        origin = "not reported: no Projected Huber density" if isinstance(made, Density) else NONE
    return named | batch.positions[row] | {"uncertainty": origin, "warnings": sighting.warnings} | batch.scores[row]


def uncertainty(temperature: Temperature | None) -> str:
    """The origin of the uncertainty: as trained, or recalibrated."""
    if temperature is None:
        return "as trained"
    return f"recalibrated: {temperature}"


def rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Lists of numbers for JSON; None for a number that is not finite."""
    return _rounded(np.asarray(values).tolist())


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
