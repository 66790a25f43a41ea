"""The arguments of verbs that are no Hydra programmes: key=value, held against a model of what there may be."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from phd_exp.records.errors import ConfigError, complaint, nearest
from phd_exp.records.files import remove_temporaries

Arguments_ = TypeVar("Arguments_", bound="Arguments")
Item = TypeVar("Item")


class Arguments(BaseModel):
    """Arguments of a verb; a key without a default must be given."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def parsed(verb: str, model: type[Arguments_], words: Sequence[str]) -> Arguments_:
    """The arguments of `key=value` words. Raises ConfigError, in one line, for the first that is none."""
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not value:
            raise ConfigError(f"{word}: expected key=value; {_takes(verb, model)}")
        if key in values:
            raise ConfigError(f"{key}: given twice")
        values[key] = value
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ConfigError(_complaint(verb, model, error.errors(include_url=False)[0])) from None


def four_numbers(text: Any, expected: str) -> tuple[float, float, float, float]:
    """The numbers of A,B,C,D, with brackets or without. Raises ValueError, saying what was expected."""
    numbers = str(text).strip("[]()").split(",")
    try:
        a, b, c, d = map(float, numbers)
    except ValueError:
        raise ValueError(f"expected {expected}") from None
    return a, b, c, d


def output_folder(out: Path) -> Path:
    """A folder to write into, made if missing. Raises ConfigError where that cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        remove_temporaries(out)  # of a process that was killed
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); choose another by out=") from None
    return out


def say_if_unfinished(run: Path, state: str) -> None:
    """A note on stderr where a run is used that has not ended well."""
    if state != "finished":
        print(f"note: {run}: the run is {state}; its last checkpoint is used", file=sys.stderr)


def with_progress(items: Iterable[Item], n: int, words: str) -> Iterator[Item]:
    """The items, with a bar where stderr is a terminal and there are several."""
    if n == 1 or not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, words, n, console=Console(stderr=True), transient=True)


def _complaint(verb: str, model: type[Arguments], problem: ErrorDetails) -> str:
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"{key}: unknown key{nearest(key, model.model_fields)}; {_takes(verb, model)}"
    if problem["type"] == "missing":
        return f"{key}: missing; {_takes(verb, model)}"
    return complaint(key, problem)


def _takes(verb: str, model: type[Arguments]) -> str:
    keys = ", ".join(f"{key}=" for key in model.model_fields)
    return f"{verb} takes {keys} (see `python -m phd_exp {verb} --help`)"
