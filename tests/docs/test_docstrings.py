"""Every public name has a docstring, and the examples in docstrings run."""

import ast
import doctest
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from phd_exp.cli import PACKAGE
from tests.docs.pages import module

Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_public_name_has_a_docstring() -> None:
    missing = []
    for file in FILES:
        tree, place = ast.parse(file.read_text()), module(file)
        missing += [place] * (ast.get_docstring(tree) is None)
        missing += [f"{place}.{name}" for name in _undocumented(tree) if not _overrides(place, name)]
    assert not missing, "\n".join(["without a docstring:", *missing])


def test_examples_run(capsys: pytest.CaptureFixture[str]) -> None:
    failed = [example.name for file in FILES for example in _examples(file) if _failures(example)]
    assert failed == [], capsys.readouterr().out


def _examples(file: Path) -> list[doctest.DocTest]:
    """The examples of a module; none if an optional dependency of the module is not installed."""
    if ">>> " not in file.read_text():
        return []
    try:
        found = import_module(module(file))
    except ModuleNotFoundError as error:
        if (error.name or "phd_exp").startswith("phd_exp"):
            raise
        return []
    examples = [example for example in doctest.DocTestFinder().find(found) if example.examples]
    assert examples, f"{file}: no example was collected"
    return examples


def _failures(example: doctest.DocTest) -> int:
    return doctest.DocTestRunner().run(example).failed


def _undocumented(node: ast.AST, prefix: str = "") -> Iterator[str]:
    """Public classes, functions and methods without a docstring, with dots."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Definition) and not child.name.startswith("_"):
            if ast.get_docstring(child) is None:
                yield f"{prefix}{child.name}"
            if isinstance(child, ast.ClassDef):
                yield from _undocumented(child, f"{prefix}{child.name}.")


def _overrides(place: str, name: str) -> bool:
    """Whether a method overrides one that has a docstring."""
    owner, _, method = name.rpartition(".")
    kind = getattr(import_module(place), owner, None)
    parents = kind.__mro__[1:-1] if isinstance(kind, type) else ()  # the last is object
    return any(vars(parent)[method].__doc__ for parent in parents if method in vars(parent))
