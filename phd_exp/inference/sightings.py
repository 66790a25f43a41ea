"""Detections in image files, each seen by a network: read in the order of their lines, predicted in batches."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from phd_exp.data.crops import read_image
from phd_exp.data.folder import content_of
from phd_exp.geometry.virtual import intrinsics
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.inference.views import View
from phd_exp.models.heads import Prediction
from phd_exp.records.detections import Detection
from phd_exp.records.errors import RunError
from phd_exp.records.images import pillow_warnings


@dataclass(frozen=True, eq=False)
class Sighting:
    """A detection, its image, and what a network says of it in the frame of the view's virtual camera (float64).

    `raw` are the network's numbers, of which `Predictor.predict` makes the prediction.
    """

    detection: Detection
    image: Image.Image
    view: View
    raw: Float[Tensor, " n_outputs"]
    prediction: Prediction


def sightings(predictor: Predictor, detections: Sequence[Detection]) -> Iterator[Sighting]:
    """What the network says of each detection.

    Raises DatasetError, naming the file, where an image is none, and RunError where the network's numbers are not
    finite.
    """
    seen = _seen(predictor, detections)
    while batch := list(islice(seen, BATCH)):
        f = torch.tensor([view.camera.f for _, _, view in batch], dtype=torch.float64)
        raw = predictor.raw(np.stack([view.image for _, _, view in batch]), f).double()
        for row, (detection, image, view) in enumerate(batch):
            if not bool(raw[row].isfinite().all()):
                raise RunError(
                    f"{detection.where}: the network returns numbers that are not finite; train the run again"
                )
            yield Sighting(detection, image, view, raw[row], predictor.predict(raw[row], f[row]))


def _seen(
    predictor: Predictor, detections: Sequence[Detection]
) -> Iterator[tuple[Detection, Image.Image, View]]:
    """The detections with what is seen of them; neighbours in one file share its image."""
    last: tuple[Path, Image.Image] | None = None
    for detection in detections:
        if last is None or last[0] != detection.file:
            with pillow_warnings():
                last = detection.file, read_image(detection.file, content_of(detection.file))
        image = last[1]
        K = intrinsics(*detection.focal_lengths_and_centre(*image.size))
        view = predictor.preparation.view(image, K, detection.box(*image.size), detection.where)
        yield detection, image, view
