"""A trained run as a function: `load(DIR)` gives a callable from image arrays to distributions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from phd_exp.data.sources import RenderedSource
from phd_exp.distributions import ProjectedHuber, Temperature
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import DepthScale
from phd_exp.geometry.virtual import intrinsics
from phd_exp.inference.views import View
from phd_exp.models.heads import Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, DatasetError, RunError, shown
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import FolderConfig, RunConfig, check
from phd_exp.training.network import build_regressor, load_checkpoint, require_same_shrinking

WEIGHTS = "regressor."
"""What the names of the network's weights begin with in a checkpoint."""
BATCH = 64


@dataclass(frozen=True)
class Constants:
    """What a network was told of its data set, in pixels of its own images (see `Source`)."""

    depth: DepthScale
    constant_f: float


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained network, in float32 whatever arithmetic it was trained in.

    Args:
        config: of the run.
        side: of the network's image, pixels.
        depth: the constants that normalise depth.
        constant_f: the focal length that it is told for every image, px; None: the true one.
        temperature: of recalibrated predictions; None: as trained.
        state: how the run stands, "finished" for one that has ended well.
    """

    config: RunConfig
    regressor: Regressor
    side: int
    depth: DepthScale
    constant_f: float | None
    device: torch.device
    temperature: Temperature | None
    state: str

    @property
    def is_probabilistic(self) -> bool:
        """Whether it predicts densities; a baseline predicts points."""
        return issubclass(self.regressor.head.prediction, ProjectedHuber)

    def __call__(
        self,
        images: UInt8[np.ndarray | Tensor, "*batch height width 3"],
        *,
        f: float | Sequence[float] | Float[np.ndarray | Tensor, " batch"],
    ) -> Prediction:
        """What whole images show, in the frame of their camera: a batch of predictions, or one for one image.

        Args:
            images: RGB of 8 bits, (n, height, width, 3) or (height, width, 3), of any size.
            f: focal length, pixels of these images; one for all or one each. The principal point is in the middle.

        Returns a ProjectedHuber (metres); of a baseline a PointEstimate. For crops and other cameras see `view`.
        Raises DatasetError where images or f are none.
        """
        array = _images(images)
        height, width = array.shape[1:3]
        centre, box = (width / 2, height / 2), (0.0, 0.0, float(width), float(height))
        views = [
            View.of_box(
                Image.fromarray(image), intrinsics(value, value, *centre), box, self.side, f"image {row}"
            )
            for row, (image, value) in enumerate(zip(array, _focal_lengths(f, len(array)), strict=True))
        ]
        return self.see(views if images.ndim == 4 else views[0])

    def view(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        K: Float[np.ndarray, "3 3"],
        box: tuple[float, float, float, float] | None = None,
    ) -> View:
        """What the network sees of a box (left, top, right, bottom, px; None: all) in an image of a camera K.

        Predictions of it are in the frame of `view.camera`, whose `to_real` is the way back.
        Raises DatasetError where the image is none, or where no pinhole camera sees the box.
        """
        (array,) = _images(image[None])
        height, width = array.shape[:2]
        left, top, right, bottom = map(float, (0, 0, width, height) if box is None else box)
        return View.of_box(Image.fromarray(array), K, (left, top, right, bottom), self.side, "image")

    def see(self, views: View | Sequence[View]) -> Prediction:
        """Predictions for views, each in the frame of its own virtual camera; for one view, one without a batch."""
        one = isinstance(views, View)
        sequence = [views] if isinstance(views, View) else views
        f = torch.tensor([view.camera.f for view in sequence], dtype=torch.float32)
        parts = [
            self.raw(
                np.stack([view.image for view in sequence[start : start + BATCH]]), f[start : start + BATCH]
            )
            for start in range(0, len(sequence), BATCH)
        ]
        raw = torch.cat(parts)
        return self.predict(raw[0], f[0]) if one else self.predict(raw, f)

    def raw(
        self, images: UInt8[np.ndarray, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch n_outputs"]:
        """The network's numbers before the head, on the CPU; f in pixels of its images."""
        known = self.camera(f.float().to(self.device)).f
        return self.regressor.raw(torch.from_numpy(images).to(self.device), known).cpu()

    def predict(self, raw: Float[Tensor, "*batch n_outputs"], f: Float[Tensor, "*batch"]) -> Prediction:
        """From the network's numbers, and focal lengths in pixels of its images, to predictions."""
        prediction = self.regressor.head(raw, self.camera(f))
        if self.temperature is not None and isinstance(prediction, ProjectedHuber):
            return self.temperature.apply(prediction)
        return prediction

    def camera(self, f: Float[Tensor, "*batch"]) -> Camera:
        """The camera as the network knows it."""
        return Camera(f, float(self.side)).with_constant_f(self.constant_f)


def load(run: Path, device: str = "auto", recalibrate: bool = False) -> Predictor:
    """The network of a run's last checkpoint.

    Args:
        run: the run's folder.
        device: "auto" takes a GPU if there is one.
        recalibrate: at the temperatures that fit the run's predictions of held-out samples.

    Raises RunError where there is no usable run, ConfigError where its configuration is none, names code of others,
    or cannot be recalibrated.
    """
    folder = RunFolder(Path(run))
    if not folder.config_file.exists():
        raise RunError(f"{folder.path}: no run; expected a folder with config.yaml and checkpoints/last.ckpt")
    config = check(folder.config(), "stored")
    require_same_shrinking(folder, config)
    constants = _constants(folder, config)
    place = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device)
    regressor = build_regressor(config, constants.depth)
    _load_weights(regressor, folder.last_checkpoint)
    status = folder.status()
    return Predictor(
        config=config,
        regressor=regressor.requires_grad_(False).eval().to(place),
        side=config.data.image_size,
        depth=constants.depth,
        constant_f=constants.constant_f if config.camera.focal_length == "constant" else None,
        device=place,
        temperature=_temperature(folder, regressor) if recalibrate else None,
        state="unknown" if status is None else status.state,
    )


def _constants(folder: RunFolder, config: RunConfig) -> Constants:
    """As recorded; those of a rendered data set follow from its specification too."""
    if not isinstance(config.data, FolderConfig):
        data = config.data
        source = RenderedSource(DatasetFolder(data.folder), data.spec, {}, data.image_size)
        return Constants(source.depth, source.constant_f)
    if not folder.constants_file.exists():
        raise RunError(
            f"{folder.constants_file}: missing, so that the depth scale of its data is unknown; train the run again"
        )
    values = folder.constants()
    try:
        depth = DepthScale(*(float(values[name]) for name in ("mu_z0", "D", "z_centre")))
        constant_f = float(values["constant_f"])
        if not 0 < constant_f < math.inf:
            raise ValueError(f"constant_f must be positive and finite, but is {constant_f}")
        return Constants(depth, constant_f)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{folder.constants_file}: not the constants of a run ({error})") from None


def _load_weights(regressor: Regressor, checkpoint: Path) -> None:
    """Take the network's weights from a checkpoint, of which nothing but numbers is read."""
    if not checkpoint.exists():
        raise RunError(f"{checkpoint}: missing; the run has not trained a whole epoch yet")
    content = load_checkpoint(checkpoint)
    try:
        state: dict[str, Any] = content["state_dict"]
        weights = {
            name.removeprefix(WEIGHTS): value for name, value in state.items() if name.startswith(WEIGHTS)
        }
        regressor.load_state_dict(weights)
    except Exception as error:  # whatever torch stumbles over where these are other weights, or none
        reason = " ".join(str(error).split())[:120]
        raise RunError(f"{checkpoint}: not a whole checkpoint of this network ({reason})") from None


def _temperature(folder: RunFolder, regressor: Regressor) -> Temperature:
    if not issubclass(regressor.head.prediction, ProjectedHuber):
        raise ConfigError(f"{folder.path}: predicts no uncertainty, so that there is nothing to recalibrate")
    if not folder.held_out.exists():
        raise RunError(
            f"{folder.held_out}: missing; recalibration is fitted on held-out samples: train with data.n_held_out > 0"
        )
    from phd_exp.evaluation.predictions import (
        held_out_temperature,
    )  # recalibration alone needs it, and pyarrow with it

    return held_out_temperature(folder)


def _images(images: Any) -> UInt8[np.ndarray, "batch height width 3"]:
    array = images.detach().cpu().numpy() if isinstance(images, Tensor) else np.asarray(images)
    array = array[None] if array.ndim == 3 else array
    if array.dtype != np.uint8 or array.ndim != 4 or array.shape[-1] != 3 or 0 in array.shape:
        raise DatasetError(
            f"images: got {array.dtype} of shape {array.shape}; expected uint8 of shape (n, height, width, 3), RGB"
        )
    return np.ascontiguousarray(array)


def _focal_lengths(f: Any, n: int) -> list[float]:
    try:
        values = np.asarray(f.detach().cpu() if isinstance(f, Tensor) else f, dtype=float).ravel()
        values = np.broadcast_to(values, (n,))
    except (ValueError, TypeError):
        values = np.full(1, np.nan)
    if not (np.isfinite(values).all() and (values > 0).all()):
        raise DatasetError(
            f"f: got {shown(f)}; expected a focal length in pixels, positive: one, or one for each of {n} images"
        )
    return [float(value) for value in values]
