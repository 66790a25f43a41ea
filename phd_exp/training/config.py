"""What a configuration must look like: checked as a whole before anything is built.

The YAML files under conf/ hold the values, this file their types and ranges; neither repeats the other. A group
whose choices are closed (data, trainer, ...) is a model here. A group that is open to new classes (backbone, head,
loss, optimizer) names a `_target_`, and its keys are held against that target's own signature.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from phd_exp.records.choices import flatten, setting
from phd_exp.records.errors import ConfigError, shown
from phd_exp.records.shards import Shard
from phd_exp.records.spec import Angle, DatasetSpec, Range
from phd_exp.training.schedule import Schedule
from phd_exp.training.targets import Target, describe, locate

Whole = Annotated[int, Field(strict=True)]
Name = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


def _named(folder: Any) -> Any:
    """An empty text would be the present folder, which nobody means."""
    if not folder:
        raise ValueError("expected the name of a folder")
    return folder


Folder = Annotated[Path, Field(strict=False), BeforeValidator(_named)]
SMALLEST_IMAGE = 32
"""A ResNet halves the side five times."""
LARGEST_IMAGE = 4096
"""As the largest that are rendered."""
SINGLE_VIEW, MULTIVIEW = "scale", "multiview"
"""The data set whose runs can be tried on several views, and the one that shows its scenes so."""


Checked = TypeVar("Checked", bound=BaseModel)


class Section(BaseModel):
    """A part of the configuration: no key but its own, and none of them changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SizesConfig(Section):
    """How much of a data set a run uses, whatever its kind; None: all there is."""

    n_train: Annotated[Whole, Field(ge=1)] | None
    n_held_out: Annotated[Whole, Field(ge=0)]
    n_test: Annotated[Whole, Field(ge=1)] | None
    image_size: Annotated[Whole, Field(ge=SMALLEST_IMAGE, le=LARGEST_IMAGE)]
    batch_size: Annotated[Whole, Field(ge=1)]

    @model_validator(mode="after")
    def a_batch_is_full(self) -> "SizesConfig":
        """Refuse a batch larger than the training samples."""
        if self.n_train is not None and self.batch_size > self.n_train:
            raise ValueError(
                f"batch_size={self.batch_size} is larger than n_train={self.n_train}: not one batch is full"
            )
        return self


class RenderedConfig(SizesConfig):
    """A rendered data set (the keys of `DatasetSpec`) and how much of it a run uses."""

    root: Folder
    n_train: Annotated[Whole, Field(ge=1)]
    n_test: Annotated[Whole, Field(ge=1)]
    workers: Annotated[Whole, Field(ge=1)] | None
    spec: DatasetSpec

    @model_validator(mode="before")
    @classmethod
    def gather_spec(cls, values: Any) -> Any:
        """The user writes the keys of the specification beside the others, without a level of their own."""
        if not isinstance(values, dict) or "spec" in values:
            return values
        spec = {key: value for key, value in values.items() if key in DatasetSpec.model_fields}
        return {key: value for key, value in values.items() if key not in spec} | {"spec": spec}

    @model_validator(mode="after")
    def images_shrink(self) -> "RenderedConfig":
        """Refuse images larger than they were rendered."""
        if self.image_size > self.spec.sensor_size:
            raise ValueError(
                f"image_size={self.image_size} is larger than sensor_size={self.spec.sensor_size}: "
                "images are only ever shrunk"
            )
        return self

    @property
    def n_training_split(self) -> int:
        """Samples to render of the training split."""
        return self.n_train + self.n_held_out

    @property
    def name(self) -> str:
        """What its runs are named by: the variant."""
        return self.spec.variant

    @property
    def folder(self) -> Path:
        """Where the data set lies."""
        return self.root / self.spec.variant


class FolderConfig(SizesConfig):
    """A folder of the user's own images; `name` names its runs."""

    name: Name
    folder: Folder


def _kind(values: Any) -> str:
    """Which of the two a `data` section is: a rendered set has a specification, of which one stray key is none."""
    if not isinstance(values, dict | BaseModel):
        return "<rendered>"
    if isinstance(values, BaseModel):
        return "<rendered>" if isinstance(values, RenderedConfig) else "<folder>"
    specified = "spec" in values or len(DatasetSpec.model_fields.keys() & values.keys()) > 1
    return "<rendered>" if specified else "<folder>"


DataConfig = Annotated[
    Annotated[RenderedConfig, Tag("<rendered>")] | Annotated[FolderConfig, Tag("<folder>")],
    Discriminator(_kind),
]


class ModelConfig(Section):
    """The head, which decides what is predicted, and the model's name in a run's folder."""

    name: Name
    head: Target


class CameraConfig(Section):
    """What the model knows of each camera's focal length: how to compute with it; besides, what it says of depth; or
    one constant for all.
    """

    focal_length: Literal["known", "shown", "constant"]


class TrainerConfig(Section):
    """How long is trained, on what, and in which arithmetic; None: as many threads as there are cores."""

    max_epochs: Annotated[Whole, Field(ge=1)]
    accelerator: Literal["auto", "cpu", "gpu"]
    precision: Literal["auto", "float32", "bfloat16"]
    threads: Annotated[Whole, Field(ge=1)] | None
    devices: Annotated[Whole, Field(ge=1)]
    progress_bar: Annotated[bool, Field(strict=True)]


class AugmentationConfig(Section):
    """As `Augmentation`, whose arguments these are."""

    symmetries: Annotated[bool, Field(strict=True)]
    largest_zoom: Annotated[float, Field(ge=1, le=2)]
    colours: Annotated[bool, Field(strict=True)]


class RecipeConfig(Section):
    """How a network is trained, whatever it predicts."""

    name: Name
    schedule: Schedule
    warmup_steps: Annotated[Whole, Field(ge=0)]
    localisation: Annotated[float, Field(ge=0, le=1000)]
    augmentation: AugmentationConfig


class LoggerConfig(Section):
    """Where the run is logged besides its own record."""

    kind: Literal["none", "wandb"]
    project: Name
    offline: Annotated[bool, Field(strict=True)]


class MultiviewConfig(Section):
    """What several cameras are to see after the training: nothing, or so many scenes of the variant `multiview`."""

    scenes: Annotated[Whole, Field(ge=0)]
    views: Annotated[Whole, Field(ge=2, le=64)]
    angle_range: Annotated[tuple[Angle, Angle], Range]

    def spec_beside(self, spec: DatasetSpec) -> DatasetSpec:
        """The data set of several views that is otherwise the one of this specification."""
        changes = {"variant": MULTIVIEW, "views": self.views, "view_angle_range": self.angle_range}
        return DatasetSpec(**(spec.model_dump() | changes))


class EvaluationConfig(Section):
    """What is measured besides the metrics of every epoch."""

    calibration_window: Annotated[Whole, Field(ge=1)]
    calibration_every_n_epochs: Annotated[Whole, Field(ge=1)]
    every_n_epochs: Annotated[Whole, Field(ge=1)] = 1  # so in records from before there was this
    multiview: MultiviewConfig | None = None  # and this

    @model_validator(mode="after")
    def calibration_is_evaluated(self) -> "EvaluationConfig":
        """Refuse calibration curves in epochs that are not evaluated."""
        if self.calibration_every_n_epochs % self.every_n_epochs:
            raise ValueError(
                f"calibration_every_n_epochs={self.calibration_every_n_epochs} is no multiple of "
                f"every_n_epochs={self.every_n_epochs}: curves are drawn where the test samples are evaluated"
            )
        return self


class RenderConfig(Section):
    """What rendering looks at: the data, and the keys of conf/render.yaml."""

    data: RenderedConfig
    shard: Annotated[Shard, BeforeValidator(Shard.parse)] | None
    verify: Annotated[bool, Field(strict=True)]
    rerender: Annotated[Whole, Field(ge=0)]
    masks: Folder | None


class RunConfig(Section):
    """The whole configuration of one run."""

    seed: Annotated[Whole, Field(ge=0, lt=2**32)]
    runs: Folder
    preset: Name
    data: DataConfig
    model: ModelConfig
    camera: CameraConfig
    recipe: RecipeConfig
    backbone: Target
    loss: Target
    optimizer: Target
    trainer: TrainerConfig
    logger: LoggerConfig
    evaluation: EvaluationConfig

    @property
    def setting(self) -> str:
        """Preset and recipe in one word, the first level of a run's folder."""
        return setting(self.preset, self.recipe.name)

    @property
    def prediction(self) -> type[Any]:
        """What the model predicts."""
        return _prediction("model.head", self.model.head)

    @model_validator(mode="after")
    def parts_fit(self) -> "RunConfig":
        """Refuse a loss that cannot take what the model predicts."""
        made = self.prediction
        taken = _prediction("loss", self.loss)
        if not issubclass(made, taken):
            raise ValueError(
                f"loss: takes a {taken.__name__}, but model={self.model.name} predicts a {made.__name__}; "
                "leave out loss=..., and the model picks its own"
            )
        return self

    @model_validator(mode="after")
    def several_views_fit(self) -> "RunConfig":
        """Refuse several views of a model or a data set that knows none."""
        multiview = self.evaluation.multiview
        if multiview is None or multiview.scenes == 0:
            return self
        from phd_exp.distributions import ProjectedHuber  # torch, which importing this file does without

        expected = "or evaluation.multiview.scenes=0"
        if not issubclass(self.prediction, ProjectedHuber):
            raise ValueError(
                f"evaluation.multiview.scenes: model={self.model.name} predicts points, which cannot be fused by "
                f"their uncertainty; expected model=probabilistic, {expected}"
            )
        if not isinstance(self.data, RenderedConfig) or self.data.name != SINGLE_VIEW:
            raise ValueError(
                f"evaluation.multiview.scenes: several cameras see the scenes of data={SINGLE_VIEW}, not of "
                f"data={self.data.name}; expected data={SINGLE_VIEW}, {expected}"
            )
        return self


def _prediction(key: str, node: dict[str, Any]) -> type:
    """What kind of prediction a head makes or a loss takes."""
    kind = getattr(locate(node["_target_"]), "prediction", None)
    if not isinstance(kind, type) or node.get("_partial_"):
        name = key.rpartition(".")[2]
        raise ValueError(f"{key}._target_: {node['_target_']!r} is no {name}; expected one as in conf/model")
    return kind


def check(config: dict[str, Any]) -> RunConfig:
    """The configuration with its types; raises ConfigError with one line for each thing that is wrong."""
    return _validated(RunConfig, config)


def check_render(config: dict[str, Any]) -> RenderConfig:
    """The same for what rendering looks at; the rest of the run, which comes along, is not its business."""
    if _kind(config.get("data")) == "<folder>":
        raise ConfigError(
            "data=folder: there is nothing to render, these are your own images; leave out `render` to train on them"
        )
    others = RunConfig.model_fields.keys() - RenderConfig.model_fields.keys()
    return _validated(RenderConfig, {key: value for key, value in config.items() if key not in others})


def _validated(model: type[Checked], config: dict[str, Any]) -> Checked:
    _require_plain_values(config)
    try:
        return model.model_validate(config)
    except ValidationError as error:
        lines = [describe(problem, model) for problem in error.errors(include_url=False)]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None


def _require_plain_values(config: dict[str, Any]) -> None:
    for key, value in flatten(config).items():
        # Hydra evaluates it where an object is built: it would tell of this machine, whoever wrote the configuration
        if "${" in str(value):
            raise ConfigError(
                f"{key}: got {shown(value)}; expected a value, since no interpolation is evaluated here"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key}: got {value}; expected to be a finite number")
