"""The sections of a configuration: their keys, types and ranges."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, StrictBool, Tag, model_validator

from phd_exp.config.targets import Target, TrainingTarget
from phd_exp.records.dataset import SPLITS
from phd_exp.records.detections import NumberOrName
from phd_exp.records.parsing import Record
from phd_exp.records.spec import Angle, DatasetSpec, Range

Whole = Annotated[int, Field(strict=True)]
Natural = Annotated[Whole, Field(ge=0)]
Count = Annotated[Whole, Field(ge=1)]
Name = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
OF_CAMERA = ("f", "width", "height")
Factor = Annotated[float, Field(ge=1, le=10)]


def _named(folder: Any) -> Any:
    """Refuse the empty string, which pathlib takes for the current folder, and values of other types."""
    if not folder or not isinstance(folder, (str, Path)):
        raise ValueError("expected the name of a folder")
    return folder


Folder = Annotated[Path, Field(strict=False), BeforeValidator(_named)]


class SizesConfig(Record):
    """How much of a data set a run uses; None: all samples."""

    n_train: Count | None
    n_held_out: Natural
    n_test: Count | None
    image_size: Annotated[Whole, Field(ge=32, le=4096)]  # a ResNet halves the side five times
    batch_size: Count

    @property
    def labelled(self) -> tuple[Path, ...]:
        """Folders of the user's own annotated images, for training or test."""
        return ()


def _with_camera(values: dict[str, Any]) -> dict[str, Any]:
    """The keys f, width and height as a camera. Raises ValueError if one is missing, or there is a file too."""
    numbers = {key: values[key] for key in OF_CAMERA if values.get(key) is not None}
    others = {key: value for key, value in values.items() if key not in OF_CAMERA}
    if not numbers:
        return others
    if len(numbers) < len(OF_CAMERA) or others.get("camera") is not None:
        raise ValueError(f"{min(numbers)}: expected all of data.f, data.width and data.height, or data.camera alone")
    return others | {"camera": numbers}


class PhotographsConfig(Record):
    """Labelled photographs that replace a share of the samples of each training batch; without a folder, none."""

    folder: Folder | None = None
    object: NumberOrName | None = None
    share: Annotated[float, Field(gt=0, lt=1)] = 0.25

    @model_validator(mode="after")
    def of_a_folder(self) -> "PhotographsConfig":
        """Refuse the other keys without a folder."""
        if self.folder is None and self != PhotographsConfig.model_construct():
            raise ValueError("photographs: share and object need photographs, expected data.photographs.folder too")
        return self


class RenderedConfig(SizesConfig):
    """A rendered data set: the keys of `DatasetSpec`, how much of it a run uses, and photographs to train on too."""

    root: Folder
    n_train: Count
    n_test: Count
    workers: Count | None
    photographs: PhotographsConfig = PhotographsConfig()  # default for older run records
    spec: DatasetSpec

    @model_validator(mode="before")
    @classmethod
    def gather_spec(cls, values: Any) -> Any:
        """Move the keys of the specification, which the user writes next to the others, into `spec`."""
        if not isinstance(values, dict) or "spec" in values:
            return values
        values = _with_camera(values)
        spec = {key: value for key, value in values.items() if key in DatasetSpec.model_fields}
        return {key: value for key, value in values.items() if key not in spec} | {"spec": spec}

    @property
    def labelled(self) -> tuple[Path, ...]:
        return (self.photographs.folder,) if self.photographs.folder else ()

    @property
    def n_training_split(self) -> int:
        """Samples to render of the training split."""
        return self.n_train + self.n_held_out

    @property
    def name(self) -> str:
        """The variant, which names the data set and its runs."""
        return self.spec.variant

    @property
    def folder(self) -> Path:
        """The folder of the data set."""
        return self.root / self.spec.variant

    def changed(self, changes: dict[str, Any], n_test: int) -> "RenderedConfig":
        """The first `n_test` test samples of this data set with other values. Raises ValueError for invalid ones."""
        spec = DatasetSpec(**(dict(self.spec) | changes))
        return self.model_copy(update={"spec": spec, "n_train": 0, "n_held_out": 0, "n_test": n_test})


Render = Callable[..., object]
"""Renders the missing samples of a `RenderedConfig`; messages suggest the overrides `fewer` for fewer samples."""


class FolderConfig(SizesConfig):
    """A folder of the user's own images; `name` names its runs, `object` selects detections."""

    name: Name
    folder: Folder
    object: NumberOrName | None = None  # default for older run records

    @property
    def labelled(self) -> tuple[Path, ...]:
        return tuple(self.folder / split for split in SPLITS)


class SourceConfig(SizesConfig):
    """The user's own `data.sources.Source`, built with `n`, the number of samples of each part, and `side`."""

    name: Name
    n_train: Count
    n_test: Count
    source: TrainingTarget


def kind_of_data(values: Any) -> str:
    """The kind of a `data` section: it names a source, or a folder of images, or it is a rendered data set.

    With a folder it has at most one key of `DatasetSpec`.
    """
    if not isinstance(values, dict):
        return {"SourceConfig": "<source>", "FolderConfig": "<folder>"}.get(type(values).__name__, "<rendered>")
    if "source" in values:
        return "<source>"
    is_folder = "spec" not in values and len(DatasetSpec.model_fields.keys() & values.keys()) <= 1
    return "<folder>" if is_folder else "<rendered>"


DataConfig = Annotated[
    Annotated[RenderedConfig, Tag("<rendered>")]
    | Annotated[FolderConfig, Tag("<folder>")]
    | Annotated[SourceConfig, Tag("<source>")],
    Discriminator(kind_of_data),
]


class ModelConfig(Record):
    """The head, which decides what the model predicts, and the model's name in the run's folder."""

    name: Name
    head: Target


class CameraConfig(Record):
    """How the model uses the focal length. known: geometry only; shown: also an input of the network; constant: one
    value for all cameras. log f is known up to a normal error of standard deviation f_error.
    """

    focal_length: Literal["known", "shown", "constant"]
    f_error: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # default for older run records

    @model_validator(mode="after")
    def error_is_of_a_known_f(self) -> "CameraConfig":
        """Refuse an error of focal lengths that the model does not use."""
        if self.f_error and self.focal_length == "constant":
            raise ValueError(
                f"f_error: got {self.f_error}; camera=constant uses no focal length; expected 0, or camera=known"
            )
        return self


class TrainerConfig(Record):
    """Length, hardware and arithmetic of the training; threads=None: one per core.

    Further keys are arguments of Lightning's Trainer; `training/trainer.py` checks them.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    max_epochs: Count
    accelerator: Literal["auto", "cpu", "gpu"]
    precision: Literal["auto", "float32", "bfloat16"]
    threads: Count | None
    devices: Count
    progress_bar: StrictBool


class AugmentationConfig(Record):
    """The arguments of `Augmentation` and of its `Photometry`, and the shares that `PositionData` changes before."""

    symmetries: StrictBool
    largest_zoom: Annotated[float, Field(ge=1, le=2)]
    colours: StrictBool
    backdrops: Annotated[float, Field(ge=0, le=1)] = 0.0  # default for older run records
    plain: Annotated[float, Field(ge=0, le=1)] = 0.0  # default for older run records
    prints: Annotated[float, Field(ge=0, le=1)] = 0.0  # default for older run records
    occluders: Annotated[float, Field(ge=0, le=1)] = 0.0  # default for older run records
    brightness: Factor
    contrast: Factor
    gamma: Factor
    white_balance: Factor
    blur: Annotated[float, Field(ge=0, le=20)]
    noise: Annotated[float, Field(ge=0, le=100)]
    jpeg: Annotated[Whole, Field(ge=1, le=100)]


class RecipeConfig(Record):
    """How a network is trained, whatever it predicts."""

    name: Name
    schedule: Literal["constant", "cosine"]
    warmup_steps: Natural
    localisation: Annotated[float, Field(ge=0, le=1000)]
    exposure: StrictBool = False  # default for older run records
    hidden: Annotated[Whole, Field(ge=0, le=4096)] = 0  # default for older run records
    segmentation: Annotated[float, Field(ge=0, le=1000)] = 0.0  # default for older run records
    augmentation: AugmentationConfig


class MultiviewConfig(Record):
    """Evaluation on several views after the training: the number of scenes of the variant `multiview`, 0 for none."""

    scenes: Natural
    views: Annotated[Whole, Field(ge=2, le=64)]
    angle_range: Annotated[tuple[Angle, Angle], Range]


SizesOfSequences = tuple[Count, Annotated[Whole, Field(ge=2, le=10_000)]]
"""A number of sequences, and of frames in each."""
Times = Annotated[float, Field(ge=0.1, le=100)]
Change = Literal["brightness", "contrast", "gamma", "blur", "noise", "jpeg"]


class ShiftConfig(Record):
    """A change of the test samples.

    Attributes:
        data: keys of the rendered data set with other values; none: the run's own test images.
        images: a fixed change of every image: arguments of `Photometry`.
        f_factor: factor of the focal length that the network receives; the images keep the true one.
    """

    data: dict[str, Any] = Field(default_factory=dict)
    images: dict[Change, Times] = Field(default_factory=dict)
    f_factor: Times = 1.0


class EvaluationConfig(Record):
    """What is evaluated, and in which epochs."""

    calibration_window: Count
    calibration_every_n_epochs: Count
    every_n_epochs: Count = 1  # default for older run records
    held_out: StrictBool = False  # whether the held-out samples are evaluated too, for callbacks that monitor them
    eight_views: StrictBool = False  # default for older run records
    multiview: MultiviewConfig | None = None  # default for older run records
    sequences: tuple[SizesOfSequences, ...] = ()  # default for older run records
    sequence_cameras: Annotated[Whole, Field(ge=1, le=2)] = 1  # default for older run records
    shifts: dict[Name, ShiftConfig] = Field(default_factory=dict)  # default for older run records
    n_shifted: Count | None = None  # default for older run records
