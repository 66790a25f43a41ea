"""Every format holds the same table, and text from files has no effect in any."""

import io
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from markdown_it import MarkdownIt
from rich.console import Console

from phd_exp.reports.files import all_tables, csv_of, latex, markdown, run_lines
from phd_exp.reports.report import Report, read_report
from phd_exp.reports.table import Table, TableCell
from phd_exp.reports.terminal import WIDTH, print_report
from tests.support.recorded import HOSTILE, ODD_PRESET, both_tables, predicted, record
from tests.support.several import write_views


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Both paper tables, a run tested on several views, and one whose record of them is torn."""
    runs = tmp_path_factory.mktemp("runs")
    both_tables(runs)
    for seed in (0, 1):
        run = record(runs, "scale", "probabilistic", seed, predicted(seed).frame, preset="several")
        write_views(run.views, 60, a=30.0, common=0.1) if seed == 0 else run.views.write_bytes(b"torn")
    return read_report(runs)


@pytest.fixture(scope="module")
def found(records: Report) -> list[Table]:
    return [_with_a_bold_cell(table) if table.kind == "tables" else table for table in all_tables(records)]


def _with_a_bold_cell(table: Table) -> Table:
    (first, *rows), *groups = table.groups
    place = next(place for place, cell in enumerate(first.cells) if cell.ours[0].isdigit())
    cells = tuple(replace(cell, bold=index == place) for index, cell in enumerate(first.cells))
    return replace(table, groups=((replace(first, cells=cells), *rows), *groups))


def bold(table: Table) -> int:
    return sum(cell.bold for row in table.rows for cell in row.cells)


def texts(cell: TableCell) -> str:
    return " ".join(f"{cell.ours} {cell.spread} {cell.below}".split())


def test_markdown_parses_to_the_same_cells(found: list[Table]) -> None:
    for table in found:
        tokens = MarkdownIt("commonmark").enable("table").parse(markdown(table))
        cells = [
            "".join(" " if child.type == "html_inline" else child.content for child in tokens[place + 1].children)
            for place, token in enumerate(tokens)
            if token.type == "td_open"
        ]
        expected = [text for row in table.rows for text in (*row.stub, *map(texts, row.cells))]
        assert [" ".join(text.split()) for text in cells if text] == expected
        children = [child for token in tokens for child in token.children or ()]
        assert sum(child.type == "strong_open" for child in children) == bold(table)
        assert {child.content for child in children if child.type == "html_inline"} == {"<br>"}
        shown = ["".join(child.content for child in token.children) for token in tokens if token.children]
        assert set(table.gaps) <= set(shown)
        commands = [child.content for child in children if child.type == "code_inline"]
        assert commands == ([table.command] if table.command else [])
    assert any("script" in line for table in found for line in table.gaps)


def test_latex_is_balanced_and_of_one_width(found: list[Table]) -> None:
    for table in found:
        text = latex(table)
        begun, ended = (re.findall(rf"(?<!\\)\\{word}{{(\w+)}}", text) for word in ("begin", "end"))
        assert sorted(begun) == sorted(ended) == ["minipage", "table", "tabular"]
        body = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
        lines = [line for line in body.splitlines() if line.endswith(r"\\")]
        widths = {len(re.findall(r"(?<!\\)&", line)) + 1 for line in lines}
        assert widths == {len(table.stub) + len(table.columns)}
        second = sum(any(cell.below for cell in row.cells) for row in table.rows)
        assert len(lines) == 1 + len(table.rows) + second
        assert text.isascii()
        assert text.count(r"\textbf{") == bold(table)
        assert "U+" not in text or table.kind != "fusion"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here")
def test_latex_compiles(found: list[Table], tmp_path: Path) -> None:
    for number, table in enumerate(found):
        (tmp_path / f"t{number}.tex").write_text(latex(table))
    inputs = "\n".join(f"\\input{{t{number}}}\\clearpage" for number in range(len(found)))
    head = "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}"
    (tmp_path / "all.tex").write_text(f"{head}\n{inputs}\n\\end{{document}}\n")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120)
    assert run.returncode == 0, run.stdout[-2000:]
    assert "Missing" not in run.stdout


def test_csv_reads_back_with_every_digit_and_each_number_is_a_row_of_the_long_table(
    records: Report, found: list[Table]
) -> None:
    long = set(records.long["value"])
    for kind in dict.fromkeys(table.kind for table in found):
        lines = pd.concat([table.lines for table in found if table.kind == kind])
        frame = pd.read_csv(io.StringIO(csv_of(lines)), keep_default_na=False, dtype=str)
        assert list(frame.columns) == list(lines.columns)
        known = {float(text) for text in frame["mean" if "mean" in frame else "value"] if text}
        assert known
        assert known <= long, kind
    assert {preset for table in found for preset in table.lines["preset"]} == {ODD_PRESET, "several", "small"}
    lines = run_lines(records)
    assert set(lines["mean"]) <= long
    first = lines[lines["preset"] == "several"].iloc[0]
    words = dict(word.split("=") for word in first["command"].split()[3:])
    assert words == {key: str(first[key]) for key in ("preset", "data", "model", "seed")}


def test_the_terminal_prints_one_screen_of_whole_cells_and_plain_text(
    records: Report, found: list[Table], capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(records, found)
    out = capsys.readouterr().out
    assert "\x1b" not in out
    lines = out.splitlines()
    assert len(lines) <= 57  # three more name the files
    assert max(map(len, lines)) <= WIDTH
    first = next(table for table in found if table.title in out)
    flat = " ".join(out.split())
    assert all(f"{cell.ours} {cell.spread}".strip() in flat for row in first.rows for cell in row.cells)
    printed = [table for table in found if table.title in out]
    assert len(re.findall(r" \*(?=\d)", out)) == sum(map(bold, printed))
    assert f"{len(found) - len(printed)} further tables" in out
    failed = flat.index("failed: ")
    assert failed < flat.index("finished"), "first, what has not finished"
    print_report(replace(records, runs=(), searches=()), [])
    assert "no runs recorded yet; begin by: python -m phd_exp -m experiment=table1" in capsys.readouterr().out


def test_bold_is_bold_on_a_terminal(records: Report, found: list[Table], monkeypatch: pytest.MonkeyPatch) -> None:
    stream, real = io.StringIO(), Console

    def terminal(**options: object) -> Console:
        return real(**options, file=stream, force_terminal=True, color_system="standard")  # type: ignore[arg-type]

    monkeypatch.setattr("phd_exp.reports.terminal.Console", terminal)
    print_report(records, found)
    assert not re.findall(r"\*\d", stream.getvalue())
    assert re.search(r"\x1b\[1m\d", stream.getvalue())
    assert HOSTILE[:5] in stream.getvalue()
    assert "\x1b[31m" not in stream.getvalue()
