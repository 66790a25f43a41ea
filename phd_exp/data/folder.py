"""Samples from a folder of the user's own images, with one virtual camera per detection."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from phd_exp.data.batches import Batch
from phd_exp.data.cache import cached
from phd_exp.data.crops import cut, facing, image_size, read_image, true_position
from phd_exp.data.sources import Known, Part, Source, blocks
from phd_exp.geometry.charts import DepthScale
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.dataset import sha256
from phd_exp.records.detections import Detection
from phd_exp.records.errors import ConfigError, DatasetError
from phd_exp.records.images import content_of, pillow_warnings
from phd_exp.records.own_images import DetectionFolder

KNOWN = ("scale", "visibility", "truncation")  # values that are recorded with the predictions
CROP_LAYOUT = 3  # version of `cut`, recorded with each cache


@dataclass(frozen=True)
class Crop:
    """A detection and its virtual camera; `xyz` (metres) is in the frame of that camera."""

    detection: Detection
    size: tuple[int, int]
    """Width and height of the detection's image."""
    camera: VirtualCamera
    xyz: Float[np.ndarray, "3"]


class FolderSource(Source):
    """The first n detections (None: all) of each split of a folder.

    Held-out detections follow the training detections; if `n_train` is None, they are the last of the training split.
    The constants are computed from the training detections. The constructor checks everything but the images.

    Raises DatasetError, naming file and line, for an invalid sample; ConfigError if no training sample is left.
    """

    def __init__(
        self, folder: DetectionFolder, n_train: int | None, n_held_out: int, n_test: int | None, side: int
    ) -> None:
        self.folder = folder
        self.side = side
        training = crops_of(folder.detections("train", None if n_train is None else n_train + n_held_out), side)
        n_train = len(training) - n_held_out
        if n_train < 1:
            raise ConfigError(
                f"data.n_held_out: got {n_held_out}, but {folder.root / 'train'} has {len(training)} "
                "detections in all; expected fewer than that"
            )
        self.crops: dict[Part, list[Crop]] = {
            "train": training[:n_train],
            "held_out": training[n_train:],
            "test": crops_of(folder.detections("test", n_test), side),
        }
        z = torch.tensor([crop.xyz[2] for crop in self.crops["train"]], dtype=torch.float64)
        f = torch.tensor([crop.camera.f for crop in self.crops["train"]], dtype=torch.float64)
        self.depth = DepthScale.from_samples(z, f)
        self.constant_f = float((f.min() * f.max()).sqrt())

    def samples(self, part: Part) -> Batch:
        return samples_of(self.crops[part], self.side, self.folder.cache, part)

    def known(self, part: Part) -> Known:
        crops = self.crops[part]
        lines = [crop.detection.line for crop in crops]
        columns: dict[str, list[Any]] = {
            "file_name": [line.file_name for line in lines],
            "f": [crop.camera.f for crop in crops],
            "S": [self.side] * len(crops),
        }
        rendered = {name: [getattr(line, name) for line in lines] for name in KNOWN}
        columns |= {name: values for name, values in rendered.items() if values != [None] * len(lines)}
        return columns | blocks(lines)

    def count(self, part: Part) -> int:
        return len(self.crops[part])


def crops_of(detections: Sequence[Detection], side: int) -> list[Crop]:
    """The virtual camera, of `side` x `side` pixels, and the position of each detection.

    Raises DatasetError, naming file and line, for an image, a box or a position that cannot be right.
    """
    sizes: dict[Path, tuple[int, int]] = {}  # a file may have many detections
    return [_crop(detection, side, sizes) for detection in detections]


def samples_of(crops: list[Crop], side: int, cache: Path, name: str) -> Batch:
    """The samples of crops; their images are decoded once into the folder `cache`."""
    xyz = torch.from_numpy(np.stack([crop.xyz for crop in crops]).astype(np.float32))
    f = torch.tensor([crop.camera.f for crop in crops], dtype=torch.float32)
    image = torch.from_numpy(_images(crops, side, cache, name))
    return Batch(image, xyz, f, float(side), torch.arange(len(crops)))


@pillow_warnings()
def _images(crops: list[Crop], side: int, cache: Path, name: str) -> np.ndarray:
    """The crops, cached."""
    rows: dict[Path, list[int]] = {}
    for row, crop in enumerate(crops):
        rows.setdefault(crop.detection.file, []).append(row)
    checksums = {file: sha256(content_of(file)) for file in rows}

    def fill(array: np.ndarray, file: Path) -> None:
        content = content_of(file)
        if sha256(content) != checksums[file]:
            raise DatasetError(f"{file}: changed while it was read; start again")
        image = read_image(file, content)
        for row in rows[file]:
            array[row] = cut(image, crops[row].camera)

    content = [checksums[crop.detection.file].encode() + _key(crop.camera) for crop in crops]
    key = {"layout": CROP_LAYOUT, "crops": sha256(b"".join(content))}
    kept = cache / f"crops-{name}-{len(crops)}x{side}.npy"
    largest = max((math.prod(crop.size) for crop in crops), default=1)
    shape, words = (len(crops), side, side, 3), f"decoding {name.replace('_', '-')} images once"
    return cached(kept, key, shape, list(rows), fill, words, largest)


def _key(camera: VirtualCamera) -> bytes:
    """What, next to the file, determines the pixels: the lens; and camera, box and side by their homography."""
    return camera.homography.tobytes() + (b"" if camera.lens.is_pinhole else repr(camera.lens).encode())


def _crop(detection: Detection, side: int, sizes: dict[Path, tuple[int, int]]) -> Crop:
    """The virtual camera and the position of one detection; `sizes` caches the sizes of the images."""
    try:
        if detection.file not in sizes:
            sizes[detection.file] = image_size(detection.file)
    except DatasetError as error:
        raise DatasetError(f"{detection.where}: {error}") from None
    size = sizes[detection.file]
    camera = facing(detection, size, side)
    return Crop(detection, size, camera, true_position(detection, size, camera))
