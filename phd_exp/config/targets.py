"""Config nodes that name a class or function by `_target_`: who may name which, the keys it takes, and its call."""

import inspect
from collections.abc import Iterator, Mapping
from functools import partial
from importlib import import_module
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError, ValidationInfo
from pydantic.errors import PydanticSchemaGenerationError
from pydantic_core import PydanticCustomError

from phd_exp.records.errors import complaint, in_user_code, install, shown, unknown

OURS = tuple(f"phd_exp.{room}" for room in ("models", "losses", "optimizers", "geometry", "distributions"))
KNOWN = (*OURS, "torch.optim", "lightning")
OTHER_VERSION = "; use the version of phd_exp that recorded the run, see its status.json"
Trust = tuple[str, ...] | None
"""None: the user typed the configuration, which may name anything importable. Otherwise it is read from a run folder,
and may name the parts in `OURS` and those in these packages.
"""


def check_target(node: dict[str, Any], trust: Trust, where: str = "") -> dict[str, Any]:
    """Check a node, and all nodes in it, against the signatures of what they name; returns the node.

    Parameters without a default may be missing: the program passes them (the network's parameters to an optimizer,
    the depth scale of the data set to a head).

    Raises PydanticCustomError naming the key, the value, and what was expected.
    """
    nodes = list(_nodes_in({"_target_": None} | node, where))
    # every target is allowed before any is inspected
    targets = [locate(one["_target_"], trust, path) for path, one in nodes]
    for (path, one), target in zip(nodes, targets, strict=True):
        _check_keys(one, target, f"{path}." if path else "")
    return node


def _nodes_in(value: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """All nodes of a configuration with their dotted keys; a node comes before those inside it."""
    if is_node(value):
        yield path, value
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        yield from _nodes_in(child, f"{path}.{key}" if path else str(key))


def _check_keys(node: dict[str, Any], target: Any, prefix: str) -> None:
    """Check the keys of one node against the signature of its target."""
    if not isinstance(node.get("_partial_", False), bool):
        raise _error(f"{prefix}_partial_: got {shown(node['_partial_'])}; expected a bool")
    parameters, takes_any = _parameters(target)
    for key, value in node.items():
        if key in ("_target_", "_partial_"):
            continue
        if key in parameters and not is_node(value):
            _check_value(f"{prefix}{key}", value, parameters[key].annotation)
        elif key not in parameters and (key.startswith("_") or not takes_any):  # Hydra's own, as `_recursive_`
            taken = f"{node['_target_']} takes {', '.join(parameters)}"
            raise _error(unknown(f"{prefix}{key}", parameters, taken))


def _parameters(target: Any) -> tuple[Mapping[str, inspect.Parameter], bool]:
    """The parameters of a class or function, and whether it takes further keys, or has no signature."""
    try:
        parameters = inspect.signature(target).parameters
    except ValueError:  # some built-in ones
        return {}, True
    return parameters, any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())


def at_defaults(config: Any) -> dict[str, Any]:
    """The dotted keys of a configuration whose values are the defaults of what their nodes name."""
    found: dict[str, Any] = {}
    for path, node in _nodes_in(config):
        parameters, _ = _parameters(locate(node["_target_"], None))
        defaults = {key: parameter.default for key, parameter in parameters.items()}
        found |= {f"{path}.{key}": value for key, value in node.items() if defaults.get(key) == value}
    return found


def build(node: Mapping[str, Any], is_partial: bool = False) -> Any:
    """Call what a checked node names with its keys; if it `is_partial`, or has `_partial_: true`, defer the call.

    Nodes among the arguments, at any depth, are built first. Hydra's `instantiate` does the same, in more ways.

    Raises ValueError, with the error that the call raised as its cause.

    Examples:
        >>> build({"_target_": "fractions.Fraction", "numerator": 1, "denominator": 2})
        Fraction(1, 2)
    """
    target = locate(node.get("_target_"), None)
    given = {key: _built(value) for key, value in node.items() if key not in ("_target_", "_partial_")}
    if is_partial or node.get("_partial_"):
        return partial(target, **given)
    try:
        return target(**given)
    except Exception as error:  # a part of the user may raise any
        raise ValueError(f"{node['_target_']}: {type(error).__name__}: {error}") from error


def _built(value: Any) -> Any:
    """A value of a configuration, with all nodes in it built."""
    if is_node(value):
        return build(value)
    if isinstance(value, dict):
        return {key: _built(part) for key, part in value.items()}
    return [_built(part) for part in value] if isinstance(value, list) else value


def is_node(value: Any) -> bool:
    """Whether a value of a configuration names a class or function."""
    return isinstance(value, dict) and "_target_" in value


def custom_parts(config: Any) -> dict[str, str]:
    """The classes and functions that a checked configuration names outside this project and the libraries it is made
    of, with the files that define them.
    """
    names = [node["_target_"] for _, node in _nodes_in(config)]
    return {
        name: str(getattr(inspect.getmodule(locate(name, None)), "__file__", "built in"))
        for name in names
        if name and not _is_below(name, KNOWN)
    }


def is_ours(config: Any) -> bool:
    """Whether a configuration names nothing but parts of this project. Nothing is imported."""
    return all(_is_below(str(node["_target_"]), OURS) for _, node in _nodes_in(config))


def _is_below(name: str, packages: tuple[str, ...]) -> bool:
    return any(f"{name}.".startswith(f"{package}.") for package in packages)


def locate(name: Any, trust: Trust, where: str = "") -> Any:
    """The object that a `_target_` names. Raises PydanticCustomError if it is not allowed or cannot be imported."""
    path = f"{where}._target_".lstrip(".")
    if not isinstance(name, str) or "." not in name:
        raise _error(f"{path}: got {shown(name)}; expected MODULE.NAME of a class or function")
    if trust is not None and not _is_below(name, allowed := (*OURS, *trust)):
        package = name.partition(".")[0]
        advice = "" if package == "phd_exp" else f"; if you trust this run, add trust={package}"
        raise _error(f"{path}: {shown(name)} is not built from a stored configuration{advice}")
    module, _, attribute = name.rpartition(".")
    try:
        target = getattr(import_module(module), attribute)
    except Exception as error:  # a module of the user may raise any
        remedy = install(str(error)) if isinstance(error, ImportError) else ""
        if trust is not None and _is_below(name, OURS):  # a part that has left
            remedy = OTHER_VERSION
        raise _error(f"{path}: {name!r} cannot be imported ({in_user_code(error) or error}){remedy}") from None
    if not callable(target):
        raise _error(f"{path}: {name!r} is a {type(target).__name__}; expected a class or function")
    # an imported name is somebody else's code
    if trust is not None and not _is_below(str(getattr(target, "__module__", None)), allowed):
        raise _error(f"{path}: {name!r} is only imported there; expected a class or function that is defined there")
    return target


def _checked(node: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    return check_target(node, info.context["trust"] if info.context else ())


def is_typed(info: ValidationInfo) -> bool:
    """Whether the user typed the configuration that is being checked."""
    return info.context is not None and info.context["trust"] is None


def _checked_if_typed(node: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    return check_target(node, None) if is_typed(info) else node


def _each_checked_if_typed(nodes: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
    for name, node in nodes.items() if is_typed(info) else ():
        if not is_node(node):
            raise _error(f"{name}: got {shown(node)}; expected a node with a _target_")
        check_target(node, None, name)
    return nodes


Target = Annotated[dict[str, Any], AfterValidator(_checked)]
"""A node that names a class or function."""
TrainingTarget = Annotated[dict[str, Any], AfterValidator(_checked_if_typed)]
"""The same for a part that only training builds: in a stored configuration it may name anything."""
TrainingTargets = Annotated[dict[str, Any], AfterValidator(_each_checked_if_typed)]
"""Any number of such nodes, each with a name."""


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
        raise _error(complaint({**error.errors()[0], "loc": (path,)})) from None


def _error(text: str) -> PydanticCustomError:
    return PydanticCustomError("target", "{text}", {"text": text})
