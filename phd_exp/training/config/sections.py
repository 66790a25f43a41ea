"""The sections of a run's configuration, but for `data`."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from phd_exp.records.spec import Angle, DatasetSpec, Range
from phd_exp.training.config.section import Name, Section, Whole
from phd_exp.training.config.targets import Target
from phd_exp.training.schedule import Schedule

MULTIVIEW = "multiview"
"""The data set that shows its scenes to several cameras."""


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


Factor = Annotated[float, Field(ge=1, le=10)]


class AugmentationConfig(Section):
    """The arguments of `Augmentation` and of its `Photometry`."""

    symmetries: Annotated[bool, Field(strict=True)]
    largest_zoom: Annotated[float, Field(ge=1, le=2)]
    colours: Annotated[bool, Field(strict=True)]
    brightness: Factor
    contrast: Factor
    gamma: Factor
    white_balance: Factor
    blur: Annotated[float, Field(ge=0, le=20)]
    noise: Annotated[float, Field(ge=0, le=100)]
    jpeg: Annotated[Whole, Field(ge=1, le=100)]


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
