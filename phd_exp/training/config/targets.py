"""Config nodes that name a class by `_target_`: the allowed names, and the keys that the class takes."""

import inspect
from importlib import import_module
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    PydanticSchemaGenerationError,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from phd_exp.records.errors import complaint, in_our_words, nearest, shown

OURS = ("phd_exp.models.", "phd_exp.losses.", "phd_exp.optimizers.", "phd_exp.geometry.")
Origin = Literal["typed", "stored"]
"""Where a configuration comes from: the user's command line and files, or a run folder."""
ALLOWED: dict[Origin, tuple[str, ...]] = {
    "typed": (*OURS, "torch.optim.", "torch.nn.", "torchvision.models."),
    "stored": (*OURS, "torch.optim."),
}
"""Allowed prefixes of a `_target_`. The object must also be defined there, not only imported.

A stored configuration cannot build anything that downloads, as torchvision's models download their weights.
"""


def check_target(node: dict[str, Any], origin: Origin, where: str = "") -> dict[str, Any]:
    """Check a node, and all nodes in it, against the signatures of what they name; returns the node.

    Parameters without a default may be missing: the program passes them (the network's parameters to an optimizer,
    the depth scale of the data set to a head).

    Raises PydanticCustomError naming the key, the value, and what was expected.
    """
    target, prefix = locate(node.get("_target_"), origin, where), f"{where}." if where else ""
    if not isinstance(node.get("_partial_", False), bool):
        raise _error(f"{prefix}_partial_", f"got {shown(node['_partial_'])}; expected a bool")
    parameters = inspect.signature(target).parameters
    for key, value in node.items():
        if key in ("_target_", "_partial_"):
            continue
        path = f"{prefix}{key}"
        if key not in parameters:
            taken = f"{node['_target_']} takes {', '.join(parameters)}"
            raise _error(path, f"unknown key{nearest(key, parameters)}; {taken}")
        _check_nodes(path, value, origin)
        if not _is_node(value):
            _check_value(path, value, parameters[key].annotation)
    return node


def _check_nodes(path: str, value: Any, origin: Origin) -> None:
    """Check a node, or the nodes inside lists and mappings, which Hydra would build as well."""
    if _is_node(value):
        check_target(value, origin, path)
        return
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        _check_nodes(f"{path}.{key}", child, origin)


def _is_node(value: Any) -> bool:
    return isinstance(value, dict) and "_target_" in value


def locate(name: Any, origin: Origin, where: str = "") -> Any:
    """The object that a `_target_` names. Raises PydanticCustomError if it is not allowed or does not exist."""
    path, allowed = f"{where}._target_".lstrip("."), ALLOWED[origin]
    if not isinstance(name, str) or not name.startswith(allowed) or "._" in name:
        expected = f"expected a name under {', '.join(allowed)}"
        raise _error(path, f"{shown(name)} may not be built from a {origin} configuration; {expected}")
    module, _, attribute = name.rpartition(".")
    try:
        target = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise _error(path, f"{name!r} does not exist ({error})") from None
    defined = getattr(target, "__module__", None)
    if not (callable(target) and isinstance(defined, str) and f"{defined}.".startswith(allowed)):
        raise _error(path, f"{name!r} is no class or function of its own; expected one defined there")
    if not _makes_a_part(target, name):
        raise _error(path, f"{name!r} is no part of a network; expected a module, a model or an optimizer")
    return target


def _makes_a_part(target: Any, name: str) -> bool:
    """Whether a call only constructs an object; the functions of a library may do anything."""
    if name.startswith(OURS):
        return True
    from torch import nn, optim  # slow to import; `import_module` has done it already

    if inspect.isclass(target):
        return issubclass(target, (nn.Module, optim.Optimizer))
    from torchvision.models import list_models

    return target.__name__ in list_models()


def _checked(node: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    return check_target(node, info.context["origin"] if info.context else "stored")


Target = Annotated[dict[str, Any], AfterValidator(_checked)]


def describe(problem: ErrorDetails, model: type[BaseModel]) -> str:
    """One line for one error of pydantic: the key, the value, what was expected, the nearest valid key."""
    place = [str(part) for part in problem["loc"]]
    location = [part for part in place if part not in ("spec", "<rendered>", "<folder>")]
    key, context = ".".join(location), problem.get("ctx", {})
    if problem["type"] == "target":
        return f"{key}.{context['path']}: {context['reason']}"
    if problem["type"] == "extra_forbidden":
        valid = _valid_keys(model, place[:-1])
        unknown = f"{key}: unknown key (value {shown(problem['input'])}){nearest(location[-1], valid)}"
        return f"{unknown}; expected one of {', '.join(valid)}"
    if problem["type"] == "missing":
        return f"{key}: missing; expected {key}=VALUE"
    return complaint(key, problem)


def _valid_keys(model: Any, location: list[str]) -> list[str]:
    """The keys of the section at a location, which holds names of fields and tags of unions."""
    for name in location:
        if name.startswith("<"):
            model = next(get_args(member)[0] for member in get_args(model) if Tag(name) in get_args(member))
        else:
            model = model.model_fields[name].annotation
    model = next((member for member in get_args(model) if inspect.isclass(member)), model)  # of Section | None
    fields = dict(model.model_fields)
    inlined = fields.pop("spec", None)
    return [*fields, *(inlined.annotation.model_fields if inlined else ())]


def _check_value(path: str, value: Any, annotation: Any) -> None:
    if annotation is inspect.Parameter.empty:
        return
    try:
        adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=ConfigDict(arbitrary_types_allowed=True))
    except (PydanticSchemaGenerationError, NameError):  # an annotation that pydantic does not support
        return
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        raise _error(path, f"got {shown(value)}; {in_our_words(error.errors()[0]['msg'])}") from None


def _error(path: str, reason: str) -> PydanticCustomError:
    return PydanticCustomError("target", "{path}: {reason}", {"path": path, "reason": reason})
