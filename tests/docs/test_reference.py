"""The reference is complete, every name in the pages is one of this programme, and guides list every format."""

import ast
import importlib
import re
import runpy
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

import phd_exp.geometry
from phd_exp.cli import PACKAGE
from phd_exp.records.assets import MESHES, PHOTOS, SKIES
from phd_exp.records.cameras import COEFFICIENTS
from phd_exp.records.foreign import COCO_FILES
from phd_exp.records.images import FORMATS
from tests.docs.pages import DOCS, PAGES, REFERENCE, ROOT, module, name
from tests.records.test_cameras import FORMATS as WRITTEN
from tests.records.test_cameras import WITHOUT

PRIVATE = {"cli"}
"""Packages that only this programme imports."""
_DIRECTIVE = re.compile(r"^::: (\S+)$", re.MULTILINE)
_REFERENCE = re.compile(r"\]\[(phd_exp[\w.]*)\]")
_LINK = re.compile(r"\]\(([^)#:]+)[^):]*\)")


def test_every_page_is_in_the_contents_and_there() -> None:
    contents = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    assert sorted(_files(contents)) == sorted([*map(name, PAGES), "api/index.md"])


def test_the_search_has_words_for_pages_that_exist() -> None:
    words = runpy.run_path(str(DOCS / ".build" / "finding.py"))["WORDS"]
    assert set(words) <= set(map(name, PAGES))


def test_the_index_lists_every_guide() -> None:
    listed = set(re.findall(r"^\| \[.*?\]\(guides/(\S+)\)", (DOCS / "index.md").read_text(), re.MULTILINE))
    assert listed == {file.name for file in (DOCS / "guides").glob("*.md")}


def test_the_reference_has_a_page_for_every_module() -> None:
    public = [file for file in PACKAGE.glob("*/**/*.py") if file.relative_to(PACKAGE).parts[0] not in PRIVATE]
    named = [place for text in REFERENCE.values() for place in _DIRECTIVE.findall(text)]
    assert len(named) == len(set(named))
    assert {module(file) for file in public} - {phd_exp.geometry.__name__} == set(named) - {"phd_exp"}


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for link in _LINK.findall(page.read_text()):
            file = (page.parent / link).resolve()
            is_built = file.is_file() and (file.is_relative_to(DOCS) or file.parent == ROOT / "renders")
            assert link in REFERENCE or is_built, f"{name(page)}: {link}"
        for reference in _REFERENCE.findall(page.read_text()):
            assert _is_there(reference), f"{name(page)}: {reference}"


def test_symbols_are_defined_where_the_glossary_says() -> None:
    rows = [line.strip("| ").split(" | ") for line in phd_exp.geometry.__doc__.splitlines() if "`" in line]
    assert rows
    for symbol, names, _, _, where in rows:
        place = f"phd_exp.{where.strip('`')}"
        assert _is_there(place), f"{symbol}: {place}"
        for used in re.findall(r"`([A-Za-z_0-9]+)", names):
            assert re.search(rf"\b{used}\b", _source(place)), f"{symbol}: no {used} in {place}"


def test_no_word_of_a_docstring_is_taken_for_html() -> None:
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = re.sub(r"`[^`]*`", "", ast.get_docstring(node) or "")
                tags = [line for line in text.splitlines() if re.match(r"(?! {4}).*<[A-Za-z/!]", line)]
                assert tags == [], f"{file}: put it between backticks"


def _files(contents: Any) -> list[str]:
    if isinstance(contents, str):
        return [contents]
    values = contents.values() if isinstance(contents, dict) else contents
    return [file for value in values for file in _files(value)]


def _is_there(dotted: str) -> bool:
    """Whether a dotted name is a module, or leads to something in one."""
    place, rest = _module(dotted)
    found = importlib.import_module(place)
    for part in rest:
        if not hasattr(found, part) and part not in getattr(found, "__annotations__", {}):
            return False
        found = getattr(found, part, None)
    return True


def _module(dotted: str) -> tuple[str, list[str]]:
    parts = dotted.split(".")
    length = next(n for n in range(len(parts), 0, -1) if _is_module(".".join(parts[:n])))
    return ".".join(parts[:length]), parts[length:]


def _is_module(dotted: str) -> bool:
    try:
        return find_spec(dotted) is not None
    except ModuleNotFoundError:  # its parent is no package
        return False


def _source(dotted: str) -> str:
    return Path(str(importlib.import_module(_module(dotted)[0]).__file__)).read_text()


TOOLS = {
    re.sub(r"^JSON of |,.*| \d$", "", name) for name in WRITTEN | WITHOUT
}  # which the tests of camera files read


@pytest.mark.parametrize(
    ("guide", "names"),
    [
        ("own_object", [suffix[1:].upper() for suffix in MESHES if suffix != ".gltf"]),
        ("own_object", [*SKIES, "glTF", *{"JPEG" if "jp" in suffix else suffix[1:] for suffix in PHOTOS}]),
        ("own_images", FORMATS),
        ("own_images", {Path(name).name.replace("{}", "train") for name in COCO_FILES}),
        ("own_images", [*TOOLS, *COEFFICIENTS]),
    ],
)
def test_a_guide_names_all_that_is_read(guide: str, names: Iterable[str]) -> None:
    text = (DOCS / "guides" / f"{guide}.md").read_text().lower()
    assert [name for name in names if not re.search(rf"(?<!\w){re.escape(name.lower())}(?!\w)", text)] == []
