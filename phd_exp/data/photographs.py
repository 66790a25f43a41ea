"""Labelled photographs among the training samples of a rendered data set."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from phd_exp.data.batches import Batch
from phd_exp.data.folder import crops_of, samples_of
from phd_exp.data.photometry import on
from phd_exp.records.errors import DatasetError
from phd_exp.records.own_images import detections_in

PHOTOGRAPH_NUMBERS = 2  # per sample: whether a photograph replaces it, and which one
LIKENESS = 2.0  # largest factor between the sizes at which photographs and renders show the object


class Photographs:
    """The labelled detections of a folder in any layout of the user's own images, for training alone.

    Args:
        folder: the images and their annotations, without splits.
        object_name: selects detections, see `detections_in`.
        side: of the images of the virtual cameras, px.
        share: the expected share of photographs among the samples of a batch.

    Raises DatasetError, naming file and line, for an invalid detection.
    """

    def __init__(self, folder: Path, object_name: int | str | None, side: int, share: float) -> None:
        self.folder, self.side, self.share = folder, side, share
        self.crops = crops_of(detections_in(folder, object_name=object_name), side)

    def samples(self, renders: Batch) -> Batch:
        """The photographs. Raises DatasetError if they show the object much larger or smaller than the renders do.

        f/z, in pixels per metre, tells wrong units of positions, boxes of something else, and views without boxes.
        """
        found = samples_of(self.crops, self.side, self.folder / ".cache", "photographs")
        (low, high), (least, most) = (_sizes(batch) for batch in (found, renders))
        if low * LIKENESS < least or high > most * LIKENESS:
            raise DatasetError(
                f"data.photographs.folder: got {self.folder}, where one metre at the object takes {low:.3g} to "
                f"{high:.3g} pixels of a view; expected about the {least:.3g} to {most:.3g} of the renders: give "
                "positions in metres, and boxes of this object as data.box_size describes them"
            )
        return found


def _sizes(batch: Batch) -> tuple[float, float]:
    """The least and the largest f/z of samples, px/m."""
    low, high = (batch.f / batch.xyz[:, 2]).aminmax()
    return float(low), float(high)


def replaced(
    photographs: Batch, batch: Batch, chosen: Bool[np.ndarray, " batch"], numbers: Float[np.ndarray, "batch 1"]
) -> Batch:
    """The batch, with some samples replaced by random photographs, whose masks weigh nothing.

    Args:
        photographs: all photographs.
        batch: renders.
        chosen: which renders to replace.
        numbers: from 0 to 1; each chooses a photograph.
    """
    which = torch.from_numpy((len(photographs) * numbers[chosen, 0]).astype(np.int64))
    others, rows = photographs.select(which).to(batch.image.device), on(batch.image, np.flatnonzero(chosen))
    parts = {name: getattr(batch, name).index_copy(0, rows, getattr(others, name)) for name in ("image", "xyz", "f")}
    weight = None if batch.mask is None else torch.ones_like(batch.f).index_fill(0, rows, 0.0)
    return replace(batch, **parts, mask_weight=weight)
