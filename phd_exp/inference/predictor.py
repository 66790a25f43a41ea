"""A trained network as a function, from photographs to distributions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING
from warnings import warn

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.data.crops import Picture, cut
from phd_exp.distributions import Mixture, Temperature
from phd_exp.distributions.columns import parameter_columns
from phd_exp.geometry.charts import DepthScale
from phd_exp.inference.ranges import Ranges
from phd_exp.inference.views import View, focal_lengths, image_batch
from phd_exp.models.heads import Prediction
from phd_exp.models.trained import TrainedNetwork
from phd_exp.optics.lens import PINHOLE, Lens
from phd_exp.optics.virtual import Box, VirtualCamera, enlarged, intrinsics
from phd_exp.records.errors import ConfigError, DatasetError, RunError, listed
from phd_exp.records.processes import announce
from phd_exp.records.runs import RunFolder, choosing

if TYPE_CHECKING:  # imports of pyarrow
    from phd_exp.evaluation.conformal import Groups, Guarantee
    from phd_exp.evaluation.familiar import Familiarity
    from phd_exp.evaluation.parquet import Arrays


@dataclass(frozen=True, eq=False)
class Predictor:
    """A trained network, or an ensemble, in float32 whatever the precision of its training.

    Args:
        config: the configuration of the run.
        network: one network or several.
        depth: the constants that normalise depth.
        state: the state of the run, "finished" if it completed.
        folders: the runs, whose held-out samples guarantee regions.
        margin: side of the view of a box over that of the box.
        temperature: temperatures of recalibrated predictions; None: as trained.
        guarantees: whether the temperatures leave samples for `guarantee`.
        labelled: a record of `calibrate`, whose images replace those samples; see `calibrated`.
    """

    config: RunConfig
    network: TrainedNetwork
    depth: DepthScale
    state: str
    folders: tuple[RunFolder, ...]
    margin: float = 1.0
    temperature: Temperature | None = None
    guarantees: bool = True
    labelled: Path | None = None

    @property
    def side(self) -> int:
        """Side of the network's image, pixels."""
        return self.network.side

    @property
    def is_probabilistic(self) -> bool:
        """Whether it predicts Projected Huber densities, which alone are fused, recalibrated and drawn."""
        return self.network.head.prediction.has_closed_forms

    def require_densities(self, what: str) -> None:
        """Raise ConfigError, with what needs them, unless it predicts Projected Huber densities."""
        if not self.is_probabilistic:
            raise ConfigError(
                f"{self.folders[0].path}: predicts no Projected Huber densities, which {what}; expected a run of "
                "model=probabilistic"
            )

    @property
    def f_range(self) -> tuple[float, float]:
        """The focal lengths of the training images, px of the network's image.

        From 0 to infinity for a network trained on boxes, whose sizes decided.
        """
        data = self.config.data
        if not isinstance(data, RenderedConfig) or data.spec.is_box:
            return 0.0, math.inf
        low, high = data.spec.f_range
        zoom = self.side / data.spec.sensor_size
        return low * zoom, high * zoom

    @property
    def widest(self) -> float:
        """Ten times what a view shows at the largest distance of the training, m."""
        return 10 * self.side * self.depth.mu_z0 * self.depth.D

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
        array = image_batch(images)
        height, width = array.shape[1:3]
        views = [
            self.view(image, intrinsics(value, value, width / 2, height / 2))
            for image, value in zip(array, focal_lengths(f, len(array)), strict=True)
        ]
        return self.see(views if images.ndim == 4 else views[0])

    def view(
        self,
        image: Picture,
        K: Float[np.ndarray, "3 3"],
        box: Box | None = None,
        lens: Lens = PINHOLE,
        where: str = "image",
    ) -> View:
        """The network's input for a box (left, top, right, bottom, px; None: all) in an image of a camera K.

        A box is viewed `margin` times as large, a small one with a focal length of at most that of the training
        images and the pixels around it. Predictions are in the frame of `view.camera`; `view.camera.to_real` maps
        them back. `where` names the image in messages.

        Raises DatasetError if the image is invalid or the box is outside the field of every pinhole camera.
        """
        if not isinstance(image, Image.Image):
            (image,) = image_batch(image[None])
        size = image.size if isinstance(image, Image.Image) else (image.shape[1], image.shape[0])
        whole = (0.0, 0.0, float(size[0]), float(size[1]))
        part, largest_f = (enlarged(box, self.margin), self.f_range[1]) if box else (whole, math.inf)
        try:
            camera = VirtualCamera.of_box(K, part, float(self.side), lens, largest_f)
        except ValueError as error:
            raise DatasetError(f"{where}: {error}") from None
        return View(cut(image, camera), camera, box or whole, size, where)

    def see(self, views: View | Sequence[View]) -> Prediction:
        """Predictions for views, each in the frame of its virtual camera.

        A single view gives a prediction without a batch dimension.

        Warns (UserWarning) if the focal length of a view is beyond those of the training.
        """
        sequence = [views] if isinstance(views, View) else views
        if faults := list(filter(None, (self.ranges.of_view(view.camera) for view in sequence))):
            warn(f"{len(faults)} of {len(sequence)} views, first {faults[0]}", stacklevel=2)
        seen = self.predicted(sequence)
        return seen.predictions if sequence is views else self.predict(seen.raw[0], seen.f[0])

    def predicted(self, views: Sequence[View]) -> "PredictedViews":
        """What the network predicts from views. Raises RunError if an output of the network is not finite."""
        f = torch.tensor([view.camera.f for view in views], dtype=torch.float64)
        raw = self.raw(np.stack([view.image for view in views]), f)
        if not bool(raw.isfinite().all()):
            bad = views[int(raw.flatten(1).isfinite().all(-1).long().argmin())]
            raise RunError(f"{bad.where}: the network returns numbers that are not finite; train the run again")
        return PredictedViews(self, views, raw, f)

    def raw(
        self, images: UInt8[np.ndarray, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch *members n_outputs"]:
        """The raw numbers of the network, on the CPU; f in pixels of its images."""
        return self.network.raw(torch.from_numpy(images), f)

    def members(self, raw: Float[Tensor, "*batch members n"], f: Float[Tensor, "*batch"]) -> Mixture:
        """The mixture of an ensemble's predictions from its raw numbers."""
        return self.network.members(raw, f)

    def predict(
        self, raw: Float[Tensor, "*members n_outputs"], f: Float[Tensor, "*batch"], dtype: torch.dtype = torch.float64
    ) -> Prediction:
        """Predictions from the raw numbers of the network and focal lengths in pixels of its images.

        Those of an ensemble have a dimension for the members before the last.
        """
        prediction = self.network.predict(raw, f, dtype)
        if self.temperature is not None and prediction.has_closed_forms:
            return self.temperature.apply(prediction)
        return prediction

    def held_out(self) -> "Arrays":
        """The recorded predictions of held-out samples. Raises ConfigError or RunError if there are none."""
        self.require_densities("recalibrate= and coverage= need")
        views = self.network.views
        if len(self.folders) > 1 and views > 1:
            raise RunError(f"views={views}: held-out predictions of several views are recorded for single runs alone")
        files = [folder.held_out if views == 1 else folder.eight_views["held_out"] for folder in self.folders]
        for file in files:
            if not file.exists():
                remedy = "train with data.n_held_out > 0"
                if views > 1 and self.config.data.n_held_out:
                    remedy = "repeat the command of the training with evaluation.eight_views=true, and `pack` again"
                raise RunError(f"{file}: missing; held-out samples are needed: {remedy}")
        from phd_exp.evaluation.parquet import read_table  # imports pyarrow
        from phd_exp.evaluation.predictions import ensemble_table

        tables = [read_table(file) for file in files]
        return tables[0] if len(tables) == 1 else ensemble_table(tables)

    def recalibrated(self, *, guarantees: bool = False) -> "Predictor":
        """The same with temperatures fitted to its held-out samples.

        With `guarantees`, only every second one is used, so that the others can `guarantee`. Raises as `held_out`.
        """
        return self._tempered(self.held_out(), self.folders[0].path, guarantees)

    def calibrated(self, name: str, *, guarantees: bool = False) -> "Predictor":
        """The same with temperatures fitted to a record of `calibrate`.

        With `guarantees`, only every second image is used, so that the others can `guarantee`. Raises RunError if
        there is no record, or one with another margin.
        """
        file = self.folders[0].labelled(name)
        if self.network.is_ensemble:
            raise RunError(f"calibration: got an ensemble with {file.parent.parent}; expected a single run")
        if not file.exists():
            known = sorted(path.stem for path in file.parent.glob("*.parquet"))
            raise RunError(
                f"calibration: got {name}; expected {listed(known) or 'a name'} of `calibrate`; {file} is missing"
            )
        from phd_exp.evaluation.parquet import read_table  # imports pyarrow

        table = read_table(file)
        if (recorded := float(table.get("margin", np.ones(1))[0])) != self.margin:
            raise RunError(
                f"calibration: {file} is of views with margin={recorded:g}; got margin={self.margin:g}; expected the "
                "same: `calibrate` again, or change margin="
            )
        return replace(self._tempered(table, file, guarantees), labelled=file)

    def _tempered(self, table: "Arrays", file: Path, guarantees: bool) -> "Predictor":
        from phd_exp.evaluation.predictions import fit_temperature  # imports pyarrow

        try:
            temperature = fit_temperature(table, choosing(table) if guarantees else slice(None))
        except RunError as error:
            raise RunError(f"{file}: {error}") from None
        return replace(self, temperature=temperature, guarantees=guarantees)

    def guarantee(self, coverage: float, groups: "Groups | None" = None) -> "Guarantee":
        """Regions that contain the true position with a probability in (0, 1); see `evaluation.conformal`.

        Raises RunError if there are too few held-out samples or labelled images, ConfigError if the run predicts no
        uncertainty, or if its temperatures were fitted to all samples.
        """
        if not self.guarantees:
            raise ConfigError(
                "guarantee: all samples were used to fit the temperatures, so none is left to guarantee a coverage; "
                "expected a predictor from recalibrated(guarantees=True) or calibrated(NAME, guarantees=True)"
            )
        from phd_exp.evaluation.conformal import guarantee
        from phd_exp.evaluation.parquet import read_table  # imports pyarrow

        if self.labelled is None:
            return guarantee(self.held_out(), coverage, groups, self.temperature)
        origin = "labelled images, every second of those of `calibrate`"
        return guarantee(read_table(self.labelled), coverage, groups, self.temperature, origin)

    @cached_property
    def ranges(self) -> Ranges:
        """What the (first) network was trained with. Raises RunError if recorded held-out samples cannot be read."""
        return Ranges.of(self.config, self.side, self.f_range, self.folders[0].held_out)

    @cached_property
    def familiarity(self) -> "Familiarity | None":
        """The measure of `familiar`; None if it has no, or too few, recorded predictions of held-out samples."""
        if not self.is_probabilistic:
            return None
        from phd_exp.evaluation.familiar import FEWEST, Familiarity

        try:
            return Familiarity(self.held_out(), self.temperature)
        except RunError as error:
            if self.state == "finished" and self.config.data.n_held_out >= 2 * FEWEST:
                announce(f"note: no `familiar`: {error}")
            return None

    def familiar(
        self, raw: Float[Tensor, "batch *members n"], f: Float[Tensor, " batch"], prediction: Prediction | None = None
    ) -> Float[np.ndarray, " batch"] | None:
        """How usual the predictions are among held-out ones, as p-values, see `evaluation.familiar`; None if unknown.

        Small for images unlike the training images. `prediction` is the result of `predict`, if it is known already.
        """
        if self.familiarity is None:
            return None
        prediction = self.predict(raw, f) if prediction is None else prediction
        assert prediction.has_closed_forms  # only those have a familiarity
        columns = parameter_columns(prediction) | {"f": f.double(), "S": torch.full_like(f, self.side)}
        if self.network.is_ensemble:
            columns["disagreement"] = self.members(raw, f).disagreement
        distance = self.familiarity.distance({name: column.numpy() for name, column in columns.items()})
        return self.familiarity.p_value(distance)


@dataclass(frozen=True, eq=False)
class PredictedViews:
    """Views that were predicted together, as `Predictor.predicted` returns them.

    Args:
        predictor: of the predictions.
        views: the input images.
        raw: the outputs of the network.
        f: focal lengths, px of the network's images.
    """

    predictor: Predictor
    views: Sequence[View]
    raw: Float[Tensor, "views *members n_outputs"]
    f: Float[Tensor, " views"]

    @cached_property
    def predictions(self) -> Prediction:
        """The predictions in float64, each in the frame of its view."""
        return self.predictor.predict(self.raw, self.f)

    @cached_property
    def familiar(self) -> list[float] | None:
        """Their p-values among held-out samples; None if unknown."""
        found = self.predictor.familiar(self.raw, self.f, self.predictions)
        return None if found is None else found.tolist()

    @cached_property
    def warnings(self) -> list[list[str]]:
        """What is beyond the training in each view, see `Ranges.warnings`."""
        familiar: Sequence[float | None] = self.familiar or [None] * len(self.views)
        modes, ranges = self.predictions.mode.numpy(), self.predictor.ranges
        return [
            ranges.warnings(view.camera, mode, view.box, view.size, p_value)
            for view, mode, p_value in zip(self.views, modes, familiar, strict=True)
        ]
