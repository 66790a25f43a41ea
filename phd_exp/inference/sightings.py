"""Detections in image files, each predicted by a network, in batches."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from phd_exp.data.cache import LARGEST_AT_ONCE
from phd_exp.data.crops import read_image
from phd_exp.data.folder import content_of
from phd_exp.geometry.virtual import intrinsics
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.inference.views import View
from phd_exp.models.heads import Prediction
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError, RunError
from phd_exp.records.images import pillow_warnings


@dataclass(frozen=True, eq=False)
class Sighting:
    """A detection, its image, and its prediction in the frame of the view's virtual camera (float64).

    `raw` holds the outputs of the network, from which `Predictor.predict` makes the prediction.
    """

    detection: Detection
    image: Image.Image
    view: View
    raw: Float[Tensor, " n_outputs"]
    prediction: Prediction


def sightings(predictor: Predictor, detections: Sequence[Detection]) -> Iterator[Sighting]:
    """The prediction for each detection, in their order.

    Raises DatasetError, naming the file, for an invalid image, and RunError if a network output is not finite.
    """
    for batch in _batches(predictor, detections):
        f = torch.tensor([view.camera.f for _, _, view in batch], dtype=torch.float64)
        raw = predictor.raw(np.stack([view.image for _, _, view in batch]), f).double()
        for row, (detection, image, view) in enumerate(batch):
            if not bool(raw[row].isfinite().all()):
                raise RunError(
                    f"{detection.where}: the network returns numbers that are not finite; train the run again"
                )
            yield Sighting(detection, image, view, raw[row], predictor.predict(raw[row], f[row]))


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
            K = intrinsics(*detection.focal_lengths_and_centre(*image.size))
            view = View.of_box(image, K, detection.box(*image.size), predictor.side, detection.where)
        except DatasetError:
            if batch:
                yield batch  # the predictions before the invalid image are not lost
            raise
        batch.append((detection, image, view))
        if len(batch) == BATCH or pixels > LARGEST_AT_ONCE:
            yield batch
            batch, pixels = [], 0
    if batch:
        yield batch
