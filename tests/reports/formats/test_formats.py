"""Every format holds the same table, and names from outside stay text in each."""

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

from phd_exp.reports.formats.files import tidy, write_tables
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.formats.terminal import print_report
from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.runs import Report, read_report
from phd_exp.reports.table import Table, TableCell
from tests.reports.recorded import HOSTILE, ODD_PRESET, both_tables, predicted, record


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Report:
    runs = tmp_path_factory.mktemp("runs")
    both_tables(runs)
    return read_report(runs)


@pytest.fixture(scope="module")
def found(records: Report) -> list[Table]:
    return [_with_a_bold_cell(table) for table in paper_tables(records)]


def _with_a_bold_cell(table: Table) -> Table:
    (first, *rows), *groups = table.groups
    (place,) = [place for place, cell in enumerate(first.cells) if cell.ours[0].isdigit()][:1]
    cells = tuple(replace(cell, bold=index == place) for index, cell in enumerate(first.cells))
    return replace(table, groups=((replace(first, cells=cells), *rows), *groups))


def texts(cell: TableCell) -> str:
    return " ".join(f"{cell.ours} {cell.spread} {cell.below}".split())


# Markdown: read by a parser that is not ours


def rendered(table: Table) -> list:
    return MarkdownIt("commonmark").enable("table").parse(markdown(table))


def test_markdown_parses_to_the_same_cells(found: list[Table]) -> None:
    for table in found:
        tokens = rendered(table)
        cells = [
            "".join(
                " " if child.type == "html_inline" else child.content for child in tokens[place + 1].children
            )
            for place, token in enumerate(tokens)
            if token.type == "td_open"
        ]
        expected = [text for row in table.rows for text in (*row.stub, *map(texts, row.cells))]
        assert [" ".join(text.split()) for text in cells if text] == expected
        bold = [child for token in tokens for child in token.children or () if child.type == "strong_open"]
        assert len(bold) == sum(cell.bold for row in table.rows for cell in row.cells)


def test_markdown_has_no_markup_from_outside(found: list[Table]) -> None:
    (table, *_) = [table for table in found if table.gaps and table.preset == "small"]
    tokens = rendered(table)
    items = [token.content for token in tokens if token.type == "inline"]
    children = [child for token in tokens for child in token.children or ()]
    assert {child.content for child in children if child.type == "html_inline"} == {"<br>"}
    shown = ["".join(child.content for child in token.children) for token in tokens if token.type == "inline"]
    assert all(line in shown for line in table.gaps)
    assert any("script" in item for item in items)
    (command,) = [child.content for child in children if child.type == "code_inline"]
    assert command == table.command


def test_markdown_quotes_a_command_with_backticks(found: list[Table]) -> None:
    table = next(table for table in found if table.preset == ODD_PRESET)
    tokens = rendered(table)
    (code,) = [
        child.content for token in tokens for child in token.children or () if child.type == "code_inline"
    ]
    assert code == table.command
    assert "`" in code


# LaTeX


def test_latex_is_balanced_and_of_one_width(found: list[Table]) -> None:
    for table in found:
        text = latex(table)
        begun, ended = (re.findall(rf"(?<!\\)\\{word}{{(\w+)}}", text) for word in ("begin", "end"))
        assert sorted(begun) == sorted(ended) == ["minipage", "table", "tabular"]
        body = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
        lines = [line for line in body.splitlines() if line.endswith(r"\\")]
        widths = {len(re.findall(r"(?<!\\)&", line)) + 1 for line in lines}
        assert widths == {len(table.stub) + len(table.columns)}
        assert text.isascii()
        assert text.count(r"\textbf{") == sum(cell.bold for row in table.rows for cell in row.cells)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex here")
def test_latex_compiles_and_prints_what_it_should(found: list[Table], tmp_path: Path) -> None:
    for number, table in enumerate(found):
        (tmp_path / f"t{number}.tex").write_text(latex(table))
    inputs = "\n".join(f"\\input{{t{number}}}\\clearpage" for number in range(len(found)))
    head = "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}"
    document = f"{head}\n{inputs}\n\\end{{document}}\n"
    (tmp_path / "all.tex").write_text(document)
    run = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "all.tex"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=120,
    )
    assert run.returncode == 0, run.stdout[-2000:]
    assert "Output written on all.pdf" in run.stdout
    assert "Missing" not in run.stdout


# CSV


def test_csv_reads_back(found: list[Table]) -> None:
    numbers = [line for table in found for line in table.numbers]
    frame = pd.read_csv(
        io.StringIO(tidy(numbers)), float_precision="round_trip", keep_default_na=False, dtype=str
    )
    assert list(frame.columns) == list(numbers[0])
    assert len(frame) == len(numbers)
    for (_, line), expected in zip(frame.iterrows(), numbers, strict=True):
        for name, value in expected.items():
            assert line[name] == ("" if value is None else str(value)), name  # every digit
    assert set(frame["preset"]) == {ODD_PRESET, "small"}


# terminal


def test_the_terminal_shows_names_as_they_are(
    records: Report, found: list[Table], capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(records, found)
    out = capsys.readouterr().out
    assert "\x1b" not in out
    flat = " ".join(out.split())
    for table in found:
        assert " ".join(table.title.split()) in flat
        assert table.command in out  # on one line, to be copied
    assert f"{HOSTILE.split(chr(27))[0].strip()} ?[31m" in flat
    words = out.split()
    for row in found[2].rows:
        assert all(word in words or f"*{word}" in words for cell in row.cells for word in texts(cell).split())


def test_bold_is_a_star_where_there_is_no_bold(
    records: Report, found: list[Table], capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(records, found)
    stars = re.findall(r" \*(?=\d)", capsys.readouterr().out)
    assert len(stars) == sum(cell.bold for table in found for row in table.rows for cell in row.cells)


def test_bold_is_bold_on_a_terminal(
    records: Report, found: list[Table], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.StringIO()
    real = Console

    def terminal(**options: object) -> Console:
        return real(**options, file=stream, force_terminal=True, color_system="standard")  # type: ignore[arg-type]

    monkeypatch.setattr("phd_exp.reports.formats.terminal.Console", terminal)
    print_report(records, found)
    assert not re.findall(r"\*\d", stream.getvalue())
    assert re.search(r"\x1b\[1m\d", stream.getvalue())


def test_runs_with_overrides_are_listed_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    other = record(tmp_path, "occl", "mae_vz", 0, predicted(1).frame, overrides=("optimizer.lr=0.5",))
    plain.write_config({"optimizer": {"lr": 0.1}})
    other.write_config({"optimizer": {"lr": 0.5}})
    records = read_report(tmp_path)
    print_report(records, paper_tables(records))
    before, after = capsys.readouterr().out.split("Runs with other overrides, in no table of the paper")
    assert "small/occl/mae_vz/seed0 " in before
    assert other.path.name in after
    assert "overrides: optimizer.lr=0.5" in after


def test_no_runs_is_said_with_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_report(read_report(tmp_path), [])
    (line,) = capsys.readouterr().out.strip().splitlines()
    assert line.startswith(
        "no runs recorded yet; begin by: python -m phd_exp -m experiment=table1 preset=paper"
    )


# files


def test_each_table_is_two_files_and_all_are_one_csv(found: list[Table], tmp_path: Path) -> None:
    folder = write_tables(found, tmp_path / "new" / "report")
    assert folder == tmp_path / "new" / "report" / "tables"
    names = {path.name for path in folder.iterdir()}
    assert {"table1-small-whole.md", "table2-small-central.tex", "tables.csv"} <= names
    assert len(names) == 2 * len(found) + 1
    assert (folder / "table1-small-whole.md").read_text() == markdown(found[2])
