"""The table of several views holds the scores, in every format alike."""

import csv
import io
import re
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from phd_exp.reports.formats.files import tidy, write_tables
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.formats.terminal import WIDTH, print_report
from phd_exp.reports.fusion_table import fusion_tables, headline
from phd_exp.reports.runs import Report, Run, read_report
from phd_exp.reports.table import Table
from tests.reports.recorded import predicted, record
from tests.reports.several import write_views


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """A run that was tested on several views, one whose record is torn, and one without."""
    runs = tmp_path_factory.mktemp("runs")
    folders = [record(runs, "scale", "probabilistic", seed, predicted(seed).frame) for seed in (0, 1, 2)]
    write_views(folders[0].views, 60, a=30.0, common=0.1)
    folders[1].views.write_bytes(b"torn")
    return read_report(runs)


@pytest.fixture(scope="module")
def run(report: Report) -> Run:
    assert any("views.parquet: cannot be read" in note for note in report.runs[1].notes)
    return report.runs[0]


@pytest.fixture(scope="module")
def table(report: Report) -> Table:
    (found,) = fusion_tables(report)
    return found


def test_a_cell_is_a_score_with_its_interval(table: Table, run: Run) -> None:
    assert run.measured.fusion is not None
    band = run.measured.fusion.band("depth_error_mm", "mode", 2)
    (row,) = [row for row in table.groups[0] if row.stub == ("depth (mm)", "Huber, mode")]
    digits = 0 if band.value >= 100 else 1
    assert row.cells[1].ours == f"{band.value:.{digits}f}"
    assert re.fullmatch(r"\(\d+(\.\d)?–\d+(\.\d)?\)", row.cells[1].spread)
    assert not any(cell.bold for row in table.rows for cell in row.cells)


def test_what_was_measured_is_said_below(table: Table, run: Run) -> None:
    notes = " ".join(table.notes)
    assert run.measured.fusion is not None
    correlation = run.measured.fusion.correlation
    assert (
        f"have the correlation {correlation.value:.2f} ({correlation.low:.2f}–{correlation.high:.2f})"
        in notes
    )
    assert "the size of an object, common to its views, shifts all of them" in notes
    assert "the fused squared error of" in notes
    assert re.fullmatch(r"8[78]\.\d", table.groups[4][2].cells[0].below)
    assert headline(run.measured.fusion).startswith("depth error ")
    assert headline(run.measured.fusion).endswith("mm with 4")


def test_markdown_parses_to_the_same_cells(table: Table) -> None:
    tokens = MarkdownIt("commonmark").enable("table").parse(markdown(table))
    cells = [
        "".join(
            " " if child.type == "html_inline" else child.content
            for child in tokens[place + 1].children or []
        )
        for place, token in enumerate(tokens)
        if token.type == "td_open"
    ]
    expected = [
        text
        for group in table.groups
        for row in group
        for text in (*row.stub, *(f"{cell.ours} {cell.spread} {cell.below}".strip() for cell in row.cells))
    ]
    assert [cell for cell in cells if cell] == expected


def test_latex_has_every_cell_and_no_letter_that_a_font_may_lack(table: Table) -> None:
    text = latex(table)
    assert text.isascii()
    assert "U+" not in text
    assert r"\label{tab:fusion-small-scale-probabilistic-seed0}" in text
    body = text.split(r"\midrule", 1)[1].split(r"\bottomrule")[0]
    lines = [line for line in body.splitlines() if "&" in line]
    assert len(lines) == len(table.rows) + sum(any(cell.below for cell in row.cells) for row in table.rows)
    assert {line.count("&") for line in lines} == {5}


def test_csv_holds_every_number_at_full_precision(table: Table, run: Run) -> None:
    assert run.measured.fusion is not None
    lines = list(csv.DictReader(io.StringIO(tidy(table.numbers))))
    found = {
        "/".join(line[name] for name in ("quantity", "method", "cameras", "ground")): float(line["mean"])
        for line in lines
    }
    assert found == {place: band.value for place, band in run.measured.fusion.bands.items()}
    assert {(line["preset"], line["run"], line["n_scenes"]) for line in lines} == {("small", "seed0", "60")}


def test_the_terminal_shows_whole_cells(
    report: Report, table: Table, capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(report, [table])
    out = capsys.readouterr().out
    assert "…" not in out
    assert max(len(line) for line in out.splitlines() if not line.startswith("no run of a table")) <= WIDTH
    for group in table.groups:
        for row in group:
            (line,) = [
                line
                for line in out.splitlines()
                if line.split("  ")[0].strip() == row.stub[0] and f" {row.stub[1]} " in line
            ]
            for cell in row.cells:
                assert f"{cell.ours} {cell.spread}" in line


def test_files_are_named_by_their_run(table: Table, tmp_path: Path) -> None:
    stem = "fusion-small-scale-probabilistic-seed0"
    files = {path.name for path in write_tables([table], tmp_path).iterdir()}
    assert files == {f"{stem}.md", f"{stem}.tex", "fusion.csv"}
