"""Config nodes that name a class by `_target_`: the names that are allowed, and the keys that the class takes."""

import inspect
from collections.abc import Iterable
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
"""Prefixes of the names that a `_target_` may have. The object must also be defined there, not only imported.

Nothing that a stored configuration can build uses the network, as torchvision's models do for their weights.
"""

SPECIAL = {"_target_", "_partial_"}


def check_target(node: dict[str, Any], origin: Origin, where: str = "") -> dict[str, Any]:
    """Check the keys and values of a node, and of all nodes in it, against the signature of what it names.

    Parameters without a default may be missing: the programme passes them (the network's parameters to an optimizer,
    the depth scale of the data set to a head).

    Raises PydanticCustomError naming the key, the value, and what was expected.
    """
    target = locate(node.get("_target_"), origin, where)
    if not isinstance(node.get("_partial_", False), bool):
        raise _error(
            ".".join(filter(None, [where, "_partial_"])), f"got {shown(node['_partial_'])}; expected a bool"
        )
    parameters = inspect.signature(target).parameters
    for key, value in node.items():
        if key in SPECIAL:
            continue
        path = f"{where}.{key}" if where else key
        if key not in parameters:
            raise _error(
                path, f"unknown key{nearest(key, parameters)}; {node['_target_']} takes {_listed(parameters)}"
            )
        if isinstance(value, dict) and "_target_" in value:
            check_target(value, origin, path)
        else:
            _check_inner(path, value, origin)
            _check_value(path, value, parameters[key].annotation)
    return node


def _check_inner(path: str, value: Any, origin: Origin) -> None:
    """Check the nodes inside lists and mappings, which would be built as well."""
    children = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, child in children:
        inner = f"{path}.{key}"
        if isinstance(child, dict) and "_target_" in child:
            check_target(child, origin, inner)
        else:
            _check_inner(inner, child, origin)


def locate(name: Any, origin: Origin, where: str = "") -> Any:
    """The object that a `_target_` names. Raises PydanticCustomError if it is not allowed or does not exist."""
    path, allowed = f"{where}._target_" if where else "_target_", ALLOWED[origin]
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
    """Whether a call only makes an object, unlike the tools of a library."""
    if name.startswith(OURS):
        return True
    from torch import nn, optim  # seconds; `import_module` has loaded it before

    if inspect.isclass(target):
        return issubclass(target, (nn.Module, optim.Optimizer))
    from torchvision.models import list_models

    return target.__name__ in list_models()


def _checked(node: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    return check_target(node, info.context["origin"] if info.context else "stored")


Target = Annotated[dict[str, Any], AfterValidator(_checked)]


def describe(problem: ErrorDetails, model: type[BaseModel]) -> str:
    """One line for one thing wrong: the key, the value, what was expected, the nearest valid key."""
    place = [str(part) for part in problem["loc"]]
    location = [part for part in place if part != "spec" and not part.startswith("<")]
    key, context = ".".join(location), problem.get("ctx", {})
    if problem["type"] == "target":
        return ".".join([key, context["path"]]) + f": {context['reason']}"
    if problem["type"] == "extra_forbidden":
        valid = valid_keys(model, place[:-1])
        unknown = f"{key}: unknown key (value {shown(problem['input'])}){nearest(location[-1], valid)}"
        return f"{unknown}; expected one of {_listed(valid)}"
    if problem["type"] == "missing":
        return f"{key}: missing; expected {key}=VALUE"
    return complaint(key, problem)


def valid_keys(model: type[BaseModel], location: list[str]) -> list[str]:
    """The keys that a section of the configuration knows, in the words of the user."""
    node: Any = model
    for name in location:
        node = _under(node, name)
    if not _is_model(node):
        return []
    fields = dict(node.model_fields)
    inlined = fields.pop("spec", None)
    return [*fields, *(inlined.annotation.model_fields if inlined else ())]


def _under(node: Any, name: str) -> Any:
    """What a name leads to: a field of a model, or, by its tag, one of several models; None where that is nothing."""
    if _is_model(node):
        return node.model_fields[name].annotation if name in node.model_fields else None
    members = [get_args(member) for member in get_args(node)]
    return next((member[0] for member in members if member[1:] == (Tag(name),)), None)


def _is_model(node: Any) -> bool:
    return inspect.isclass(node) and issubclass(node, BaseModel)


def _check_value(path: str, value: Any, annotation: Any) -> None:
    if annotation is inspect.Parameter.empty:
        return
    try:
        adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=ConfigDict(arbitrary_types_allowed=True))
    except (PydanticSchemaGenerationError, NameError):  # an annotation beyond pydantic, as torch has some
        return
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        raise _error(path, f"got {shown(value)}; {in_our_words(error.errors()[0]['msg'])}") from None


def _error(path: str, reason: str) -> PydanticCustomError:
    return PydanticCustomError("target", "{path}: {reason}", {"path": path, "reason": reason})


def _listed(keys: Iterable[str]) -> str:
    return ", ".join(keys)
