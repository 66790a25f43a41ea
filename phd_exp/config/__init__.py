"""A configuration, checked as a whole before anything is built.

The YAML files under conf/ hold the values, this package their types and ranges. A group with a closed set of choices
(data, trainer, ...) is a model in `sections.py`. A group that is open to new classes (backbone, head, loss,
optimizer, callbacks, logger) names a `_target_`; its keys are checked against that target's signature (`targets.py`).
"""

import math
from itertools import product
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, Field, StrictBool, ValidationError, ValidationInfo, model_validator

from phd_exp.config import sections
from phd_exp.config.sections import DataConfig, FolderConfig, RenderedConfig, SourceConfig
from phd_exp.config.targets import Target, TrainingTarget, TrainingTargets, Trust, is_typed, locate
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError, complaint, gist, shown
from phd_exp.records.parsing import Record
from phd_exp.records.runs import HELD_OUT
from phd_exp.records.spec import Shard

__all__ = ["FolderConfig", "RenderConfig", "RenderedConfig", "RunConfig", "SourceConfig", "check", "check_render"]

Checked = TypeVar("Checked", bound=BaseModel)
NO_UNCERTAINTY = "predicts points without uncertainty"
NO_COVARIANCE = "has no density with a covariance, which fusion needs"
NO_CLOSED_FORMS = "predicts no Projected Huber density, which the smoother needs"
NO_SINGLE_IMAGES = "is not rendered in single images"


class RenderConfig(Record):
    """The configuration of `render`: the data, the recipe that they are for, and the keys of conf/render.yaml."""

    data: RenderedConfig
    recipe: sections.RecipeConfig
    shard: Annotated[Shard, BeforeValidator(Shard.parse)] | None
    verify: StrictBool
    rerender: sections.Natural
    masks: sections.Folder | None
    bop: sections.Folder | None

    @property
    def rendered(self) -> list[RenderedConfig]:
        """The data sets that a training with this recipe reads."""
        return _rendered(self.data, self.recipe)


class RunConfig(Record):
    """The configuration of one run."""

    seed: Annotated[sections.Whole, Field(ge=0, lt=2**32)]
    runs: sections.Folder
    preset: sections.Name
    data: DataConfig
    model: sections.ModelConfig
    camera: sections.CameraConfig
    recipe: sections.RecipeConfig
    backbone: Target
    loss: TrainingTarget
    optimizer: TrainingTarget
    trainer: sections.TrainerConfig
    logger: TrainingTargets
    callbacks: TrainingTargets = Field(default_factory=dict)
    evaluation: sections.EvaluationConfig
    init: sections.Folder | None = None  # default for older run records

    @model_validator(mode="after")
    def parts_fit(self, info: ValidationInfo) -> "RunConfig":
        """Refuse what is no head, and a loss of another type of prediction; a loss without a type fits all."""
        if not is_typed(info):
            return self
        made, taken = (_prediction(node) for node in (self.model.head, self.loss))
        if made is None:
            raise ValueError(f"model.head._target_: {self.model.head['_target_']!r} is no head; see conf/model")
        if taken is not None and not issubclass(made, taken):
            raise ValueError(
                f"loss: takes a {taken.__name__}, but model={self.model.name} predicts a {made.__name__}; "
                "leave out loss=..., and the model picks its own"
            )
        return self

    @model_validator(mode="after")
    def monitors_fit(self, info: ValidationInfo) -> "RunConfig":
        """Refuse a callback that monitors the test samples, or held-out samples without an evaluation."""
        is_held_out = self.evaluation.held_out and self.data.n_held_out > 0
        for name, node in self.callbacks.items() if is_typed(info) else ():
            monitor = str(node.get("monitor"))
            if monitor.startswith("test/") or (monitor.startswith("held_out/") and not is_held_out):
                raise ValueError(
                    f"callbacks.{name}.monitor: got {monitor}; test samples choose nothing: expected held_out/..., "
                    "with evaluation.held_out=true and data.n_held_out > 0"
                )
        return self

    @model_validator(mode="after")
    def sizes_fit(self, info: ValidationInfo) -> "RunConfig":
        """Refuse images larger than rendered, and a sequence with both training and held-out samples."""
        data, images = self.data, 1
        if isinstance(data, RenderedConfig) and data.spec.frames > 1:
            images = data.spec.frames * data.spec.views
        if is_typed(info) and data.n_held_out and data.n_train and data.n_train % images:
            raise ValueError(
                f"data.n_train: got {data.n_train}; expected a multiple of data.frames x data.views = {images}, "
                "since no sequence may have both training and held-out samples"
            )
        if isinstance(data, RenderedConfig) and data.image_size > data.spec.sensor_size:
            raise ValueError(
                f"data: image_size={data.image_size} is larger than sensor_size={data.spec.sensor_size}, but images "
                f"are only ever shrunk; write data.image_size={data.spec.sensor_size}, or render larger images"
            )
        return self

    def data_of(self, shift: str) -> DataConfig:
        """The data whose test samples a shift changes. Raises ConfigError for values that no such set has."""
        changes, data, n = self.evaluation.shifts[shift].data, self.data, self.evaluation.n_shifted
        try:
            if not isinstance(data, RenderedConfig):
                if changes:
                    raise ValueError(f"data={data.name} is not rendered; leave out this shift")
                return data
            if data.spec.camera and "f_range" in changes:
                raise ValueError("f_range follows from data.camera; expected shifts without it, such as shift=images")
            named = {"variant": f"{data.name}-{shift}"} if changes else {}
            return data.changed(named | changes, n or data.n_test)
        except ValueError as error:
            raise ConfigError(f"evaluation.shifts.{shift}.data: {gist(error)}") from None

    @property
    def rendered(self) -> list[RenderedConfig]:
        """The rendered data sets that the training reads."""
        return _rendered(self.data, self.recipe) if isinstance(self.data, RenderedConfig) else []

    @property
    def several_views(self) -> RenderedConfig | None:
        """The scenes with several cameras that follow the training, as test samples of a data set."""
        asked, data = self.evaluation.multiview, self.data
        if asked is None or asked.scenes == 0 or not isinstance(data, RenderedConfig):
            return None
        name = "multiview" if data.name == "scale" else f"{data.name}-multiview"
        changes = {"variant": name, "views": asked.views, "view_angle_range": asked.angle_range}
        return data.changed(changes, asked.scenes * asked.views)

    @property
    def sequences(self) -> dict[tuple[int, bool], RenderedConfig]:
        """The sequences that follow the training, as test samples: by their frames, and whether they are held out.

        Half as many are held out, from the same number of cameras and with another seed.
        """
        asked, multiview = self.evaluation, self.evaluation.multiview
        if not isinstance(data := self.data, RenderedConfig):
            return {}
        found, cameras, further = {}, asked.sequence_cameras, dict[str, Any]()
        if cameras > 1 and multiview:
            further = {"views": cameras, "view_angle_range": multiview.angle_range}
        seeds = data.spec.seed, (data.spec.seed + 1) % 2**63
        for (n, frames), held_out in product(asked.sequences, (False, True)):
            name = f"{data.name}-sequences-{frames}{HELD_OUT * held_out}"
            name += f"-cameras-{cameras}" if further else ""
            changes = {"variant": name, "frames": frames, "seed": seeds[held_out]} | further
            found[frames, held_out] = data.changed(changes, (-(-n // 2) if held_out else n) * frames * cameras)
        return found

    @model_validator(mode="after")
    def evaluations_fit(self) -> "RunConfig":
        """Refuse further evaluations for a model or a data set that lacks what they need."""
        asked, made = self.evaluation, _prediction(self.model.head)
        spec = self.data.spec if isinstance(self.data, RenderedConfig) else None
        scenes = asked.multiview is not None and asked.multiview.scenes > 0
        is_one_view = spec is not None and spec.views == 1
        is_single = spec is not None and spec.views == spec.frames == 1
        needs = [  # whether it is asked for, the setting without it, whether the choice fits, and what it lacks
            (asked.eight_views, "eight_views=false", hasattr(made, "log_prob"), "model", NO_UNCERTAINTY),
            (scenes, "multiview.scenes=0", getattr(made, "has_covariance", False), "model", NO_COVARIANCE),
            (scenes, "multiview.scenes=0", is_one_view, "data", "is not rendered with one view"),
            (asked.sequences, "sequences=[]", getattr(made, "has_closed_forms", False), "model", NO_CLOSED_FORMS),
            (asked.sequences, "sequences=[]", is_single, "data", NO_SINGLE_IMAGES),
        ]
        names = {"model": (self.model.name, "probabilistic"), "data": (self.data.name, "scale")}
        for is_asked, without, fits, group, lacks in needs:
            if is_asked and not fits:
                (name, usual), key = names[group], without.partition("=")[0]
                raise ValueError(
                    f"evaluation.{key}: {group}={name} {lacks}; expected {group}={usual}, or evaluation.{without}"
                )
        if len({frames for _, frames in asked.sequences}) < len(asked.sequences):
            raise ValueError("evaluation.sequences: expected pairs [sequences, frames] of different frames")
        for key, data in (("multiview", "several_views"), ("sequences", "sequences")):
            try:
                getattr(self, data)
            except ValueError as error:
                raise ValueError(f"evaluation.{key}: {gist(error)}") from None
        return self


def _prediction(node: dict[str, Any]) -> type | None:
    """The type of prediction that a head makes or a loss takes; None if it declares none."""
    kind = getattr(locate(node["_target_"], None), "prediction", None)
    return kind if isinstance(kind, type) and not node.get("_partial_") else None


def check(config: dict[str, Any], trust: Trust = None) -> RunConfig:
    """The configuration with its types. Raises ConfigError with one line for each error.

    `trust` decides which classes it may name, see `targets.Trust`.
    """
    return _validated(RunConfig, config, trust)


def _rendered(data: RenderedConfig, recipe: sections.RecipeConfig) -> list[RenderedConfig]:
    """A data set, and its backdrops without objects if the recipe uses them."""
    if not (recipe.augmentation.backdrops or recipe.augmentation.prints):
        return [data]
    return [data, data.model_copy(update={"spec": data.spec.without_objects, "n_held_out": 0, "n_test": 0})]


def check_render(config: dict[str, Any]) -> RenderConfig:
    """The configuration of `render`, given that of a run; other keys of a run are not checked."""
    if sections.kind_of_data(config.get("data")) != "<rendered>":
        raise ConfigError(
            "data=folder: there is nothing to render, these are your own images; leave out `render` to train on them"
        )
    others = RunConfig.model_fields.keys() - RenderConfig.model_fields.keys()
    kept = {key: value for key, value in config.items() if key not in others}
    return _validated(RenderConfig, kept, None)


def _validated(model: type[Checked], config: dict[str, Any], trust: Trust) -> Checked:
    for key, value in flatten(config).items():
        # Hydra evaluates them when it composes a typed configuration; a stranger's could read this machine's values
        if "${" in str(value):
            raise ConfigError(
                f"{key}: got {shown(value)}; expected a value, since no interpolation is evaluated here"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key}: got {value}; expected to be a finite number")
    try:
        return model.model_validate(config, context={"trust": trust})
    except ValidationError as error:
        problems = error.errors(include_url=False)
        lines = [complaint(problem, model, "expected {key}=VALUE") for problem in problems]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from None
