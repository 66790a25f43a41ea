"""The table of several views holds the scores, in every format alike."""

import csv
import io
import re
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from phd_exp.evaluation.fusion import Place
from phd_exp.records.errors import UserError
from phd_exp.reports.collect import collect
from phd_exp.reports.formats.files import write_fusion_tables
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.formats.terminal import WIDTH, print_complaints, print_tables
from phd_exp.reports.formats.tidy_fusion import COLUMNS, tidy_fusion
from phd_exp.reports.fusion_table import FusionTable, fusion_tables, headline
from tests.reports.recorded import predicted, record
from tests.reports.several import write_views


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was tried on several views, one whose record is torn, and one without."""
    runs = tmp_path_factory.mktemp("runs")
    for seed in (0, 1, 2):
        record(runs, "scale", "probabilistic", seed, predicted(seed).frame)
    folders = [run.folder for run in collect(runs).runs]
    write_views(folders[0].views, 60, a=30.0, common=0.1)
    folders[1].views.write_bytes(b"torn")
    return runs


@pytest.fixture(scope="module")
def table(runs: Path) -> FusionTable:
    (found,), complaints = fusion_tables(collect(runs))
    (complaint,) = complaints
    assert "seed1/views.parquet: cannot be read" in complaint
    return found


def test_a_cell_is_a_score_with_its_interval_and_the_smallest_are_bold(table: FusionTable) -> None:
    band = table.scores.bands[Place("depth_error_mm", "mode", 2, False)]
    (row,) = [row for row in table.groups[0] if row.stub == ("depth (mm)", "Huber, mode")]
    digits = 0 if band.value >= 100 else 1
    assert row.cells[1].ours == f"{band.value:.{digits}f}"
    assert re.fullmatch(r"\(\d+(\.\d)?–\d+(\.\d)?\)", row.cells[1].spread)
    for group in table.groups[:4]:
        for cells in zip(*(row.cells for row in group), strict=True):
            values = [float(cell.ours) for cell in cells]
            assert [cell.bold for cell in cells] == [value == min(values) for value in values]
    assert not any(cell.bold for group in table.groups[4:] for row in group for cell in row.cells)


def test_what_was_measured_is_said_below(table: FusionTable) -> None:
    notes = " ".join(table.notes)
    correlation = table.scores.correlation
    assert (
        f"have the correlation {correlation.value:.2f} ({correlation.low:.2f}–{correlation.high:.2f})"
        in notes
    )
    assert "the size of an object, common to its views, shifts all of them" in notes
    assert "the fused squared error of" in notes
    assert headline(table.scores).startswith("depth error ")
    assert headline(table.scores).endswith("mm with 4")


def test_markdown_parses_to_the_same_cells(table: FusionTable) -> None:
    tokens = MarkdownIt("commonmark").enable("table").parse(markdown(table))
    cells = [
        "".join(child.content for child in tokens[place + 1].children or [])
        for place, token in enumerate(tokens)
        if token.type == "td_open"
    ]
    expected = [
        text
        for group in table.groups
        for row in group
        for text in (*row.stub, *(f"{cell.ours} {cell.spread}" for cell in row.cells))
    ]
    assert [cell for cell in cells if cell] == expected


def test_latex_has_every_cell_and_no_letter_that_a_font_may_lack(table: FusionTable) -> None:
    text = latex(table)
    assert text.isascii()
    assert "U+" not in text
    assert r"\label{tab:fusion-small-scale-probabilistic-seed0}" in text
    assert text.count(r"\textbf{") == sum(
        cell.bold for group in table.groups for row in group for cell in row.cells
    )
    body = text.split(r"\midrule", 1)[1].split(r"\bottomrule")[0]
    lines = [line for line in body.splitlines() if "&" in line]
    assert len(lines) == sum(map(len, table.groups))
    assert {line.count("&") for line in lines} == {5}


def test_csv_holds_every_number_at_full_precision(table: FusionTable) -> None:
    lines = list(csv.DictReader(io.StringIO(tidy_fusion([table]))))
    assert tuple(lines[0]) == COLUMNS
    found = {
        Place(line["quantity"], line["method"], int(line["cameras"]), line["ground"] == "True"): float(
            line["mean"]
        )  # type: ignore[arg-type]
        for line in lines
    }
    assert found == {place: band.value for place, band in table.scores.bands.items()}
    assert {(line["preset"], line["run"], line["n_scenes"]) for line in lines} == {("small", "seed0", "60")}


def test_the_terminal_shows_whole_cells(table: FusionTable, capsys: pytest.CaptureFixture[str]) -> None:
    print_tables([table])
    print_complaints(["seed1: torn"])
    out = capsys.readouterr().out
    assert "…" not in out
    assert max(map(len, out.splitlines())) <= WIDTH
    assert "Not fused: seed1: torn" in out
    for group in table.groups:
        for row in group:
            (line,) = [
                line
                for line in out.splitlines()
                if line.split("  ")[0].strip() == row.stub[0] and f" {row.stub[1]} " in line
            ]
            for cell in row.cells:
                assert f"{cell.ours} {cell.spread}" in line


def test_files_are_named_by_their_run(table: FusionTable, tmp_path: Path) -> None:
    folder = write_fusion_tables([table], tmp_path)
    stem = "fusion-small-scale-probabilistic-seed0"
    assert {path.name for path in folder.iterdir()} == {f"{stem}.md", f"{stem}.tex", "fusion.csv"}
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="choose another folder by out=DIR"):
        write_fusion_tables([table], tmp_path / "file")
