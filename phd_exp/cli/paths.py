"""Paths in Hydra's grammar, which refuses accents, brackets, `=`, `,`, `#` and `~` without quotes."""

import os
import re
from collections.abc import Iterable

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

PATHS = (
    "runs",
    "init",
    "masks",
    "bop",
    "data.root",
    "data.folder",
    "data.mesh",
    "data.backdrops",
    "data.distractor_meshes",
    "data.camera",
)
"""The keys whose values are paths."""
_PARTS = re.compile(r"""\s*'(?:\\.|[^'\\])*'\s*(?=,|$)|\s*"(?:\\.|[^"\\])*"\s*(?=,|$)|[^,]+""")


def quoted(words: Iterable[str], several: bool = False) -> list[str]:
    """The words with those paths in quotes that Hydra would read as something else, and with the home folder for `~`.

    A path that exists is one value; otherwise commas separate the values of a list and, with `several`, of a sweep.
    What Hydra reads as one value stays as it is, because it is a part of the run's name.

    Examples:
        >>> quoted(["runs=runs", "data.mesh=box(1).obj", "seed=1"])
        ['runs=runs', "data.mesh='box(1).obj'", 'seed=1']
        >>> quoted(["data.mesh=a.obj,b#2.obj"], several=True)
        ["data.mesh=a.obj,'b#2.obj'"]
    """
    return [_quoted(word, several) for word in words]


def _quoted(word: str, several: bool) -> str:
    key, _, value = word.partition("=")
    if key.lstrip("+") not in PATHS or not value:
        return word
    value = os.path.expanduser(value) if value.startswith("~/") else value
    parts, form = [value], "{}"
    if not os.path.exists(value):
        read = _read(value)
        if read and read.is_sweep_override() and not getattr(read.value(), "simple_form", False):
            return word  # choice(...), glob(...)
        if value.startswith("[") and value.endswith("]"):
            parts, form = _PARTS.findall(value[1:-1]), "[{}]"
        elif several:
            parts = _PARTS.findall(value)
    return f"{key}={form.format(','.join(map(_one_value, parts)))}"


def _one_value(text: str) -> str:
    read = _read(text)
    if read and not (read.is_sweep_override() or isinstance(read.value(), list | dict)):
        return text
    return QuotedString(text, Quote.single).with_quotes()


def _read(value: str) -> Override | None:
    try:
        return OverridesParser.create().parse_override(f"path={value}")
    except HydraException:
        return None
