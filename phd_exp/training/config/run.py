"""Whole configurations: of a run, and of what `render` looks at."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from phd_exp.records.choices import setting
from phd_exp.records.spec import Shard
from phd_exp.training.config.data import DataConfig, RenderedConfig
from phd_exp.training.config.section import Folder, Name, Section, Whole
from phd_exp.training.config.sections import (
    CameraConfig,
    EvaluationConfig,
    LoggerConfig,
    ModelConfig,
    RecipeConfig,
    TrainerConfig,
)
from phd_exp.training.config.targets import Target, locate

SINGLE_VIEW = "scale"
"""The data set whose runs can be tried on several views."""


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
    def sizes_fit(self) -> "RunConfig":
        """Refuse a batch larger than the training set, and images larger than they were rendered."""
        data = self.data
        if data.n_train is not None and data.batch_size > data.n_train:
            raise ValueError(
                f"data: batch_size={data.batch_size} is larger than n_train={data.n_train}: not one batch is full"
            )
        if isinstance(data, RenderedConfig) and data.image_size > data.spec.sensor_size:
            raise ValueError(
                f"data: image_size={data.image_size} is larger than sensor_size={data.spec.sensor_size}: "
                "images are only ever shrunk"
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
    kind = getattr(locate(node["_target_"], "typed"), "prediction", None)
    if not isinstance(kind, type) or node.get("_partial_"):
        name = key.rpartition(".")[2]
        raise ValueError(f"{key}._target_: {node['_target_']!r} is no {name}; expected one as in conf/model")
    return kind
