"""The keys of a verb with their types, defaults and descriptions, for its --help."""

import re
from collections.abc import Iterator
from importlib import import_module
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from phd_exp.cli import conf_folder
from phd_exp.training.config import RenderConfig, RunConfig

LINE = re.compile(r"( *)(\w+):(?: +([^#]*?))?(?: *# *(.*))?")
"""A line of YAML: indentation, key, value and comment."""
FILES = {"train": {"config": "", "trainer/auto": "trainer.", "recipe/paper": ""}, "render": {"render": ""}}
"""Verb -> the files of conf/ that explain its keys, with what precedes these; those of DATA follow for both."""
DATA = {"data/default": "data.", "data/object": "data."}
NAMES = {int: "int", float: "float", bool: "bool", NoneType: "null", tuple: "list"}
Key = tuple[str, str, str, str]
"""Name, type, default and description."""


def keys_of(verb: str) -> list[Key]:
    """All keys of a verb, except the arguments of the classes that its groups choose."""
    if verb in FILES:
        files, model = FILES[verb] | DATA, RunConfig if verb == "train" else RenderConfig
        return [key for file, prefix in files.items() for key in _in(file, prefix, model)]
    arguments: type[BaseModel] = getattr(import_module(f"phd_exp.cli.{verb}"), f"{verb.title()}Arguments")
    return [
        (name, _type(field.annotation), _default(field), field.description or "")
        for name, field in arguments.model_fields.items()
    ]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    return "null" if field.default is None else str(field.default).lower()


def _in(file: str, prefix: str, model: type[BaseModel]) -> Iterator[Key]:
    """The keys in a file of conf/ that have a comment."""
    sections: list[str] = []
    for text in (conf_folder() / f"{file}.yaml").read_text().splitlines():
        if not (found := LINE.fullmatch(text)):
            continue
        depth = len(found[1]) // 2
        sections = [*sections[:depth], found[2]]
        name = prefix + ".".join(sections)
        if found[3] and found[4] and (annotation := _annotation(model, name.split("."))):
            yield name, _type(annotation), found[3], found[4]


def _annotation(annotation: Any, names: list[str]) -> Any:
    """The type of a key below a model; None if it has no such key. Keys of `data.spec` are written one level up."""
    if not names:
        return annotation
    for model in _models(annotation):
        fields = model.model_fields
        if names[0] in fields:
            return _annotation(fields[names[0]].annotation, names[1:])
        if "spec" in fields and (found := _annotation(fields["spec"].annotation, names)):
            return found
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
