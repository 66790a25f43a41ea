"""A configuration as Hydra composed it or a run recorded it: typed, or refused with one line for each fault."""

import math
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError, shown
from phd_exp.training.config.data import is_folder
from phd_exp.training.config.run import RenderConfig, RunConfig
from phd_exp.training.config.targets import Origin, describe

Checked = TypeVar("Checked", bound=BaseModel)


def check(config: dict[str, Any], origin: Origin = "typed") -> RunConfig:
    """The configuration with its types. Raises ConfigError with one line for each error.

    Its origin decides what it may build, see `targets.ALLOWED`.
    """
    return _validated(RunConfig, config, origin)


def check_render(config: dict[str, Any]) -> RenderConfig:
    """The same for what rendering looks at; the rest of the run, which comes along, is not its business."""
    if is_folder(config.get("data")):
        raise ConfigError(
            "data=folder: there is nothing to render, these are your own images; leave out `render` to train on them"
        )
    others = RunConfig.model_fields.keys() - RenderConfig.model_fields.keys()
    return _validated(
        RenderConfig, {key: value for key, value in config.items() if key not in others}, "typed"
    )


def _validated(model: type[Checked], config: dict[str, Any], origin: Origin) -> Checked:
    _require_plain_values(config)
    try:
        return model.model_validate(config, context={"origin": origin})
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
