"""The notebooks contain prose, calls and their outputs, and they run."""

import ast
import json
import re
import runpy
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [file.name for file in FILES]
LARGEST = 1_800_000
"""Bytes of all notebooks together, outputs included."""
ABSOLUTE = re.compile(r"(?<![\w.~:/<>*-])/(?:home|root|tmp|usr|opt|work|mnt|var|Users)/|[A-Z]:\\\\")
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def read(file: Path) -> nbformat.NotebookNode:
    return nbformat.read(file, as_version=4)


def code_of(file: Path) -> list[nbformat.NotebookNode]:
    return [cell for cell in read(file).cells if cell.cell_type == "code"]


def defines(source: str) -> bool:
    nodes = list(ast.walk(ast.parse(source)))
    assigned = [node.value for node in nodes if isinstance(node, ast.Assign | ast.AnnAssign | ast.NamedExpr)]
    return any(isinstance(node, DEFINITIONS) for node in nodes) or any(
        isinstance(value, ast.Lambda) for value in assigned
    )


def test_they_are_numbered() -> None:
    assert [name[:3] for name in NAMES] == [f"{place:02d}_" for place in range(1, len(NAMES) + 1)] != []


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_a_notebook_is_valid_explained_executed_and_defines_nothing(file: Path) -> None:
    notebook = read(file)
    nbformat.validate(notebook)
    assert notebook.cells[0].cell_type == "markdown"
    cells = code_of(file)
    assert not [cell.source for cell in cells if defines(cell.source)]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_it_records_neither_time_nor_place(file: Path) -> None:
    notebook = read(file)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    assert not any(cell.metadata for cell in notebook.cells)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            output.get("data", {}).pop("image/png", None)
    assert not ABSOLUTE.search(json.dumps(notebook))


def test_all_together_are_light() -> None:
    assert sum(file.stat().st_size for file in FILES) < LARGEST


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_they_run_on_nothing_at_smoke_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder, one after the other, so that the data sets and runs they share are made once."""
    monkeypatch.setenv("PHD_EXP_PRESET", "smoke")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    script = runpy.run_path(str(ROOT / "notebooks" / "execute.py"))
    for file in filter(script["is_possible"], FILES):
        notebook = read(file)
        script["execute"](notebook, tmp_path)
        assert "image/png" in json.dumps(notebook), file.name
    assert not [path for path in (ROOT / "notebooks").iterdir() if path.name in {"renders", "runs"}]
