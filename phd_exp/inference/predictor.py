"""A trained run as a function: `load(DIR)` gives a callable from image arrays to distributions."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from phd_exp.data.crops import cut
from phd_exp.data.sources import RenderedSource
from phd_exp.distributions import Mixture, ProjectedHuber, Temperature
from phd_exp.distributions.columns import parameter_columns
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import DepthScale
from phd_exp.geometry.motion import EIGHT, turned
from phd_exp.geometry.virtual import Box, VirtualCamera, intrinsics
from phd_exp.inference.ensembles import held_out_table, members_of, require_alike
from phd_exp.models.heads import DistributionHead, Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, DatasetError, RunError, shown
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig, check
from phd_exp.training.config.targets import Trust
from phd_exp.training.network import build_regressor, load_checkpoint, require_same_shrinking

if TYPE_CHECKING:  # imports of pyarrow
    from phd_exp.evaluation.conformal import Groups, Guarantee
    from phd_exp.evaluation.familiar import Familiarity
    from phd_exp.evaluation.parquet import Columns

WEIGHTS = "regressor."  # prefix of the network's weights in a checkpoint
BATCH = 64


@dataclass(frozen=True, eq=False)
class View:
    """The input image of a network, prepared as in training, and its virtual camera, whose frame predictions have.

    Examples:
        >>> photo, K = Image.new("RGB", (90, 60)), intrinsics(300.0, 300.0, 45.0, 30.0)
        >>> View.of_box(photo, K, (50.0, 10.0, 80.0, 50.0), side=32, where="photo").image.shape
        (32, 32, 3)
    """

    image: UInt8[np.ndarray, "S S 3"]
    camera: VirtualCamera

    @classmethod
    def of_box(
        cls,
        image: Image.Image,
        K: Float[np.ndarray, "3 3"],
        box: Box | None,
        side: int,
        where: str,
        largest_f: float = np.inf,
    ) -> "View":
        """The view of a box in an RGB image (None: all of it), `side` pixels a side.

        A small box is viewed with a focal length of `largest_f` pixels, and the pixels around it.

        Raises DatasetError, naming `where`, if the box is too wide.
        """
        left, top, right, bottom = map(float, (0, 0, *image.size) if box is None else box)
        largest_f = np.inf if box is None else largest_f
        try:
            camera = VirtualCamera.of_box(K, (left, top, right, bottom), float(side), largest_f=largest_f)
        except ValueError as error:
            raise DatasetError(f"{where}: {error}") from None
        return cls(cut(image, camera), camera)

    @property
    def is_turned(self) -> bool:
        """Whether the frame of the virtual camera differs from that of the real camera."""
        return not np.array_equal(self.camera.R, np.eye(3))


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained network, or an ensemble, in float32 whatever the precision of its training.

    The members of an ensemble are networks, and for each the symmetric views of an image. It predicts the Projected
    Huber distribution that is closest to their mixture.

    Args:
        config: the configuration of the run.
        side: side of the network's image, pixels.
        depth: the constants that normalise depth.
        constant_f: the focal length that the network receives for every image, px; None: the true one.
        temperature: temperatures of recalibrated predictions; None: as trained.
        state: the state of the run, "finished" if it completed.
        folders: the runs, whose held-out samples guarantee regions.
        others: the further networks of an ensemble.
        views: number of symmetric views of each image, 1 or 8.
    """

    config: RunConfig
    regressor: Regressor
    side: int
    depth: DepthScale
    constant_f: float | None
    device: torch.device
    temperature: Temperature | None
    state: str
    folders: tuple[RunFolder, ...] = ()
    others: tuple[Regressor, ...] = ()
    views: int = 1

    @property
    def networks(self) -> tuple[Regressor, ...]:
        """The network, or all networks of an ensemble."""
        return (self.regressor, *self.others)

    @property
    def is_ensemble(self) -> bool:
        """Whether it has several members."""
        return bool(self.others) or self.views > 1

    @property
    def is_probabilistic(self) -> bool:
        """Whether it predicts Projected Huber densities, which alone are fused, recalibrated and drawn."""
        return issubclass(self.regressor.head.prediction, ProjectedHuber)

    @property
    def largest_f(self) -> float:
        """The largest focal length at which boxes are viewed, px: that of the training images.

        Infinity for a network trained on the user's own images, whose boxes decided.
        """
        data = self.config.data
        if not isinstance(data, RenderedConfig):
            return math.inf
        return data.spec.f_range[1] * self.side / data.spec.sensor_size

    def __call__(
        self,
        images: UInt8[np.ndarray | Tensor, "*batch height width 3"],
        *,
        f: float | Sequence[float] | Float[np.ndarray | Tensor, " batch"],
    ) -> Prediction:
        """Predictions for whole images in the frame of their camera: a batch, or one without a batch for one image.

        Args:
            images: RGB of 8 bits, (n, height, width, 3) or (height, width, 3), of any size.
            f: focal length, pixels of these images; one for all or one each. The principal point is in the middle.

        Returns a ProjectedHuber (metres), or a PointEstimate for a baseline. For crops and other cameras see `view`.
        Raises DatasetError if images or f are invalid.
        """
        array = _images(images)
        height, width = array.shape[1:3]
        cameras = [intrinsics(value, value, width / 2, height / 2) for value in _focal_lengths(f, len(array))]
        views = [
            View.of_box(Image.fromarray(image), K, None, self.side, f"image {row}")
            for row, (image, K) in enumerate(zip(array, cameras, strict=True))
        ]
        return self.see(views if images.ndim == 4 else views[0])

    def guarantee(self, coverage: float, groups: "Groups | None" = None) -> "Guarantee":
        """Regions that contain the true position with a probability in (0, 1); see `evaluation.conformal`.

        Raises RunError if the run has too few held-out samples, ConfigError if it predicts no uncertainty.
        """
        from phd_exp.evaluation.conformal import guarantee

        return guarantee(_held_out(self), coverage, groups, self.temperature)

    def view(
        self, image: UInt8[np.ndarray, "height width 3"], K: Float[np.ndarray, "3 3"], box: Box | None = None
    ) -> View:
        """The network's input for a box (left, top, right, bottom, px; None: all) in an image of a camera K.

        Predictions for it are in the frame of `view.camera`; `view.camera.to_real` maps them back.
        Raises DatasetError if the image is invalid or the box is outside the field of every pinhole camera.
        """
        (array,) = _images(image[None])
        return View.of_box(Image.fromarray(array), K, box, self.side, "image", self.largest_f)

    def see(self, views: View | Sequence[View]) -> Prediction:
        """Predictions for views, each in the frame of its own virtual camera; for one view, one without a batch."""
        sequence = [views] if isinstance(views, View) else views
        f = torch.tensor([view.camera.f for view in sequence], dtype=torch.float32)
        raw = self.raw(np.stack([view.image for view in sequence]), f)
        return self.predict(raw, f) if sequence is views else self.predict(raw[0], f[0])

    def raw(
        self, images: UInt8[np.ndarray, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch *members n_outputs"]:
        """The raw numbers of the network, on the CPU, at most 64 images at a time; f in pixels of its images."""
        known = self.camera(f.float().to(self.device)).f
        n = BATCH // self.views
        batches = zip(torch.from_numpy(images).split(n), known.split(n), strict=True)
        return torch.cat([self.outputs(image.to(self.device), f).cpu() for image, f in batches])

    def outputs(
        self, image: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch *members n_outputs"]:
        """The raw numbers of the network, or of all members of an ensemble, in the frame of each image."""
        if not self.is_ensemble:
            return self.regressor.raw(image, f)
        signs = EIGHT[: self.views]
        views = torch.stack([turned(image, sign) for sign in signs], dim=1).flatten(0, 1)
        f = f.repeat_interleave(self.views)
        raw = torch.stack([network.raw(views, f).unflatten(0, (-1, self.views)) for network in self.networks], dim=1)
        head = self.regressor.head
        assert isinstance(head, DistributionHead)  # checked by `load`
        return head.turned_back(raw, torch.tensor(signs).to(raw)).flatten(1, 2)

    def members(self, raw: Float[Tensor, "*batch members 7"], f: Float[Tensor, "*batch"]) -> Mixture:
        """The mixture of an ensemble's predictions, in float64, from its raw numbers."""
        prediction = self.regressor.head(raw.double(), self.camera(f.double()[..., None]))
        assert isinstance(prediction, ProjectedHuber)  # checked by `load`
        return Mixture(prediction)

    @cached_property
    def familiarity(self) -> "Familiarity | None":
        """The measure of `familiar`; None if it has no, or too few, recorded predictions of held-out samples."""
        if not self.is_probabilistic:
            return None
        from phd_exp.evaluation.familiar import Familiarity

        with suppress(RunError):
            return Familiarity(_held_out(self), self.temperature)
        return None

    def familiar(
        self, raw: Float[Tensor, "batch *members 7"], f: Float[Tensor, " batch"]
    ) -> Float[np.ndarray, " batch"] | None:
        """How usual the predictions are among held-out ones, as p-values, see `evaluation.familiar`; None if unknown.

        Small for images unlike the training images.
        """
        if self.familiarity is None:
            return None
        prediction = self.predict(raw.double(), f.double())
        assert isinstance(prediction, ProjectedHuber)  # only those have a familiarity
        columns = parameter_columns(prediction) | {"f": f.double(), "S": torch.full_like(f, self.side)}
        if self.is_ensemble:
            columns["disagreement"] = self.members(raw, f).disagreement
        distance = self.familiarity.distance({name: column.numpy() for name, column in columns.items()})
        return self.familiarity.p_value(distance)

    def predict(self, raw: Float[Tensor, "*batch n_outputs"], f: Float[Tensor, "*batch"]) -> Prediction:
        """Predictions from the raw numbers of the network and focal lengths in pixels of its images.

        Those of an ensemble have a dimension for the members before the last.
        """
        prediction = self.members(raw, f).closest if self.is_ensemble else self.regressor.head(raw, self.camera(f))
        if self.temperature is not None and isinstance(prediction, ProjectedHuber):
            return self.temperature.apply(prediction)
        return prediction

    def camera(self, f: Float[Tensor, "*batch"]) -> Camera:
        """The camera as the network receives it."""
        return Camera(f, float(self.side)).with_constant_f(self.constant_f)


def load(
    run: str | Path | Sequence[str | Path],
    device: str = "auto",
    recalibrate: bool = False,
    trust: Trust = (),
    views: int = 1,
) -> Predictor:
    """The network of a run's best checkpoint, or its last; or an ensemble of several runs or views.

    Args:
        run: the run's folder; several, or a folder of seeds, for an ensemble.
        device: "auto" chooses a GPU if there is one.
        recalibrate: apply the temperatures that fit the run's predictions of held-out samples.
        trust: packages other than phd_exp whose classes the run may build; None: any.
        views: 8 for an ensemble of the eight symmetric views of each image.

    Raises:
        RunError: the folder holds no usable run.
        ConfigError: its configuration is invalid, names code that is not trusted, or cannot be recalibrated; or the
            runs do not fit together.
    """
    folders, matters = members_of([run] if isinstance(run, str | Path) else run)
    first, *others = predictors = [_load(folder, device, trust) for folder in folders]
    if others or views > 1:
        require_alike(folders, predictors, matters)
        state = next((one.state for one in predictors if one.state != "finished"), "finished")
        networks = tuple(other.regressor for other in others)
        first = replace(first, folders=tuple(folders), others=networks, views=views, state=state)
    if not recalibrate:
        return first
    from phd_exp.evaluation.predictions import fit_temperature  # imports pyarrow

    return replace(first, temperature=fit_temperature(_held_out(first)))


def _load(folder: RunFolder, device: str, trust: Trust) -> Predictor:
    """The network of one run, as trained."""
    if not folder.config_file.exists():
        raise RunError(f"{folder.path}: no run; expected a folder with config.yaml and checkpoints/last.ckpt")
    config = check(folder.config(), trust)
    require_same_shrinking(folder, config)
    depth, constant_f = _constants(folder, config)
    place = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device)
    regressor = build_regressor(config, depth, is_new=False)
    _load_weights(regressor, folder.best_checkpoint)
    status = folder.status()
    return Predictor(
        config=config,
        regressor=regressor.requires_grad_(False).eval().to(place),
        side=config.data.image_size,
        depth=depth,
        constant_f=constant_f if config.camera.focal_length == "constant" else None,
        device=place,
        temperature=None,
        state="unknown" if status is None else status.state,
        folders=(folder,),
    )


def _constants(folder: RunFolder, config: RunConfig) -> tuple[DepthScale, float]:
    """Depth scale and constant f of the run's data: as recorded, or from the specification of a rendered data set."""
    if isinstance(config.data, RenderedConfig):
        data = config.data
        source = RenderedSource(DatasetFolder(data.folder), data.spec, {}, data.image_size)
        return source.depth, source.constant_f
    file = folder.constants_file
    if not file.exists():
        raise RunError(f"{file}: missing, so that the depth scale of its data is unknown; train the run again")
    values = folder.constants()
    try:
        constant_f = float(values["constant_f"])
        if not 0 < constant_f < math.inf:
            raise ValueError(f"constant_f must be positive and finite, but is {constant_f}")
        return DepthScale(*(float(values[name]) for name in ("mu_z0", "D", "z_centre"))), constant_f
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{file}: not the constants of a run ({error})") from None


def _load_weights(regressor: Regressor, checkpoint: Path) -> None:
    """Load the network's weights from a checkpoint; only tensors are read."""
    if not checkpoint.exists():
        raise RunError(f"{checkpoint}: missing; the run has not trained a whole epoch yet")
    content = load_checkpoint(checkpoint)
    try:
        state: dict[str, Any] = content["state_dict"]
        regressor.load_state_dict(
            {name.removeprefix(WEIGHTS): value for name, value in state.items() if name.startswith(WEIGHTS)}
        )
    except Exception as error:  # torch raises many kinds for other weights, or none
        reason = " ".join(str(error).split())[:120]
        raise RunError(f"{checkpoint}: not a whole checkpoint of this network ({reason})") from None


def _held_out(predictor: Predictor) -> "Columns":
    """The predictions of held-out samples. Raises ConfigError or RunError if there are none."""
    if not predictor.is_probabilistic:
        raise ConfigError(
            f"{predictor.folders[0].path}: no Projected Huber densities, which recalibrate= and coverage= need; "
            "expected a run of model=probabilistic"
        )
    return held_out_table(predictor.folders, predictor.views)


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
