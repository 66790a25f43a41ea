"""Whatever phd_exp offers under a name of its own says what it is, or overrides what says it."""

import ast
from collections.abc import Iterator
from importlib import import_module

from phd_exp.cli import PACKAGE
from tests.docs.pages import module

Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def test_every_public_name_says_what_it_is() -> None:
    silent = []
    for file in sorted(PACKAGE.rglob("*.py")):
        tree, place = ast.parse(file.read_text()), module(file)
        silent += [place] * (ast.get_docstring(tree) is None)
        silent += [f"{place}.{name}" for name in _undocumented(tree) if not _is_said_by_a_parent(place, name)]
    assert not silent, "\n".join(["without a docstring:", *silent])


def test_an_override_may_be_silent_and_nothing_else() -> None:
    tree = ast.parse("class C:\n '''.'''\n def f(self): ...\n def _g(self): ...\n class D: ...\ndef h(): ...")
    assert list(_undocumented(tree)) == ["C.f", "C.D", "h"]
    assert _is_said_by_a_parent("phd_exp.geometry.charts", "Projected.position")
    assert not _is_said_by_a_parent("phd_exp.geometry.charts", "Projected.__post_init__")
    assert not _is_said_by_a_parent("phd_exp.geometry.charts", "projected")


def _undocumented(node: ast.AST, prefix: str = "") -> Iterator[str]:
    """Public classes, functions and methods without a docstring, with dots."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, Definition) and not child.name.startswith("_"):
            if ast.get_docstring(child) is None:
                yield f"{prefix}{child.name}"
            if isinstance(child, ast.ClassDef):
                yield from _undocumented(child, f"{prefix}{child.name}.")


def _is_said_by_a_parent(place: str, name: str) -> bool:
    """Whether a method overrides one that has a docstring."""
    owner, _, method = name.rpartition(".")
    kind = getattr(import_module(place), owner, None)
    parents = kind.__mro__[1:-1] if isinstance(kind, type) else ()  # the last is object
    return any(vars(parent)[method].__doc__ for parent in parents if method in vars(parent))
