"""The keys of a verb with their types, defaults and descriptions, for its --help."""

import re
from collections.abc import Iterator
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from phd_exp.cli import conf_folder, prefix_of
from phd_exp.config import RenderConfig, RunConfig
from phd_exp.records.choices import flatten
from phd_exp.records.errors import keys_of_section, one_line
from phd_exp.records.parsing import parse_yaml

LINE = re.compile(r"( *)(\w+):(?: +([^#]*?))?(?: *# *(.*))?")
"""A line of YAML: indentation, key, value and comment."""
RENDERED = {
    "data/default": "data: any rendered data set",
    "data/object": "data=object: further keys, and other defaults than above",
}
FILES = {
    "train": {
        "config": "",
        "trainer/auto": "trainer",
        "camera/known": "camera",
        "optimizer/adam": "optimizer=adam",
        "optimizer/muon": "optimizer=muon",
        "recipe/paper": "recipe=paper",
        **RENDERED,
        "data/folder": "data=folder",
    },
    "render": {"render": "", **RENDERED},
}
"""Verb -> the files of conf/ that explain its keys, with their headings."""
MISSING = "???"  # the value of a key that has none
NAMES = {int: "int", float: "float", bool: "bool", NoneType: "null", tuple: "list", dict: "section"}
Key = tuple[str, str, str, str]
"""Name, type, default and description."""


def keys_of(verb: str) -> dict[str, list[Key]]:
    """Heading -> the keys of a verb, except the arguments of most classes that its groups choose."""
    if verb in FILES:
        model = RunConfig if verb == "train" else RenderConfig
        return {heading: list(_in(file, model)) for file, heading in FILES[verb].items()}
    arguments: type[BaseModel] = getattr(import_module(f"phd_exp.cli.{verb}"), f"{verb.title()}Arguments")
    return {
        "": [
            (name, _type(field.annotation), _default(field), one_line(field.description or ""))
            for name, field in arguments.model_fields.items()
        ]
    }


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    return "null" if field.default is None else str(field.default).lower()


def _in(file: str, model: type[BaseModel]) -> Iterator[Key]:
    """The keys in a file of conf/ that have a comment."""
    content = (conf_folder() / f"{file}.yaml").read_text()
    group = file.rpartition("/")[0]
    prefix = prefix_of(group, content)
    by_preset = flatten(parse_yaml((conf_folder() / "preset/paper.yaml").read_text()))
    sections: list[str] = []
    for text in content.splitlines():
        if not (found := LINE.fullmatch(text)):
            continue
        depth = len(found[1]) // 2
        sections = [*sections[:depth], found[2]]
        name = prefix + ".".join(sections)
        if not (found[3] and found[4]):
            continue
        unset = "set by preset" if name in by_preset else "required"
        default = {MISSING: unset, "{}": "empty"}.get(found[3], found[3])
        # the arguments of a class have no model
        of_class = type(parse_yaml(found[3])) if group == "optimizer" else None
        if annotation := of_class or _annotation(model, name.split(".")):
            yield name, _type(annotation), default, found[4]


def _annotation(annotation: Any, names: list[str]) -> Any:
    """The type of a key below a model; None if it has no such key."""
    if not names:
        return annotation
    for model in _models(annotation):
        if found := keys_of_section(model).get(names[0]):
            return _annotation(found, names[1:])
    return None


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _type(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(parts[0])
    if origin is Literal:
        return "|".join(map(str, parts))
    if origin in (Union, UnionType):
        return " or ".join(map(_type, parts))
    return NAMES.get(origin or annotation, "text")
