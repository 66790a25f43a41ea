"""Every format holds the same table, and text from files has no effect in any."""

import csv
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

from phd_exp.reports.files import all_tables, latex, markdown, run_lines, tidy
from phd_exp.reports.runs import Report, Run, read_report
from phd_exp.reports.table import Table, TableCell
from phd_exp.reports.terminal import WIDTH, print_report
from tests.support.recorded import HOSTILE, ODD_PRESET, both_tables, predicted, record
from tests.support.several import write_views

FUSION = "fusion-several-scale-probabilistic-seed0"


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Both paper tables, a run tested on several views, and one whose record of them is torn."""
    runs = tmp_path_factory.mktemp("runs")
    both_tables(runs)
    folders = [
        record(runs, "scale", "probabilistic", seed, predicted(seed).frame, preset="several") for seed in (0, 1)
    ]
    write_views(folders[0].views, 60, a=30.0, common=0.1)
    folders[1].views.write_bytes(b"torn")
    return read_report(runs)


@pytest.fixture(scope="module")
def found(records: Report) -> list[Table]:
    tables = all_tables(records)
    return [_with_a_bold_cell(table) if table.kind == "tables" else table for table in tables]


def _with_a_bold_cell(table: Table) -> Table:
    (first, *rows), *groups = table.groups
    place = next(place for place, cell in enumerate(first.cells) if cell.ours[0].isdigit())
    cells = tuple(replace(cell, bold=index == place) for index, cell in enumerate(first.cells))
    return replace(table, groups=((replace(first, cells=cells), *rows), *groups))


@pytest.fixture(scope="module")
def several(records: Report) -> Run:
    whole, torn = (run for run in records.runs if run.preset == "several")
    assert any("views.parquet: cannot be read" in note for note in torn.notes)
    return whole


def one(found: list[Table], stem: str) -> Table:
    return next(table for table in found if table.stem == stem)


def bold(table: Table) -> int:
    return sum(cell.bold for row in table.rows for cell in row.cells)


def texts(cell: TableCell) -> str:
    return " ".join(f"{cell.ours} {cell.spread} {cell.below}".split())


# Markdown, read by an independent parser


def rendered(table: Table) -> list:
    return MarkdownIt("commonmark").enable("table").parse(markdown(table))


def test_markdown_parses_to_the_same_cells(found: list[Table]) -> None:
    for table in found:
        tokens = rendered(table)
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
    assert any("`" in table.command for table in found)


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
        second = sum(any(cell.below for cell in row.cells) for row in table.rows)
        assert len(lines) == 1 + len(table.rows) + second
        assert text.isascii()
        assert text.count(r"\textbf{") == bold(table)
    text = latex(one(found, FUSION))
    assert "U+" not in text
    assert rf"\label{{tab:{FUSION}}}" in text


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
    assert "Output written on all.pdf" in run.stdout
    assert "Missing" not in run.stdout


# CSV


def test_csv_reads_back_with_every_digit(found: list[Table]) -> None:
    for kind in ("tables", "fusion"):
        numbers = [line for table in found if table.kind == kind for line in table.numbers]
        frame = pd.read_csv(io.StringIO(tidy(numbers)), keep_default_na=False, dtype=str)
        assert list(frame.columns) == list(numbers[0])
        expected = [["" if value is None else str(value) for value in line.values()] for line in numbers]
        assert frame.to_numpy().tolist() == expected
    assert {line["preset"] for table in found for line in table.numbers} == {ODD_PRESET, "several", "small"}


# terminal


def test_the_terminal_prints_whole_cells_and_plain_text(
    records: Report, found: list[Table], capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(records, found)
    out = capsys.readouterr().out
    assert not {"\x1b", "…"} & set(out)
    flat = " ".join(out.split())
    for table in found:
        assert " ".join(table.title.split()) in flat
        assert table.command in out  # on one line, to be copied
    assert f"{HOSTILE.split(chr(27))[0].strip()} ?[31m" in flat
    starred = re.findall(r" \*(?=\d)", out)
    assert len(starred) == sum(map(bold, found))
    print_report(replace(records, runs=()), [one(found, FUSION)])
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if not line.startswith("no runs recorded")) <= WIDTH
    for row in one(found, FUSION).rows:
        label, method = row.stub
        (line,) = (line for line in lines if line.split("  ")[0].strip() == label and f" {method} " in line)
        assert all(f"{cell.ours} {cell.spread}" in line for cell in row.cells)


def test_bold_is_bold_on_a_terminal(records: Report, found: list[Table], monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    real = Console

    def terminal(**options: object) -> Console:
        return real(**options, file=stream, force_terminal=True, color_system="standard")  # type: ignore[arg-type]

    monkeypatch.setattr("phd_exp.reports.terminal.Console", terminal)
    print_report(records, found)
    assert not re.findall(r"\*\d", stream.getvalue())
    assert re.search(r"\x1b\[1m\d", stream.getvalue())


def test_runs_with_overrides_are_listed_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    other = record(tmp_path, "occl", "mae_vz", 0, predicted(1).frame, overrides=("optimizer.lr=0.5",))
    report = read_report(tmp_path)
    print_report(report, all_tables(report))
    before, after = capsys.readouterr().out.split("Runs with other overrides, in no table of the paper")
    assert "small/occl/mae_vz/seed0 " in before
    assert other.path.name in after
    assert "overrides: optimizer.lr=0.5" in after


# files, and the table of several views


def test_each_run_is_lines_from_which_the_tables_follow(found: list[Table], records: Report) -> None:
    lines = pd.read_csv(io.StringIO(tidy(run_lines(records))), dtype={"overrides": str})
    cells = pd.read_csv(io.StringIO(tidy([cell for table in found for cell in table.numbers if "table" in cell])))
    keys = ["preset", "data", "model", "estimate", "reading", "quantity"]
    means = lines.groupby(keys)["mean"].agg(["mean", "size"])
    made = cells[cells["n_seeds"] > 0]
    assert len(made) > 20
    for cell in made.itertuples():
        mean, n = means.loc[tuple(getattr(cell, key) for key in keys)]
        assert (mean, n) == (pytest.approx(cell.mean), cell.n_seeds)
    run = next(run for run in records.runs if run.nll is not None)
    own = lines[(lines["preset"] == run.preset) & (lines["data"] == run.data) & (lines["seed"] == run.seed)]
    assert own[(own["model"] == run.model) & (own["quantity"] == "nll")]["mean"].item() == pytest.approx(run.nll)
    first = lines[lines["preset"] == "several"].iloc[0]
    words = dict(word.split("=") for word in first["command"].split()[3:])
    assert words == {key: str(first[key]) for key in ("preset", "data", "model", "seed")}
    assert first["machine"] == records.runs[0].status.machine  # type: ignore[union-attr]  # it is there


def test_the_fusion_table_holds_the_scores(found: list[Table], several: Run) -> None:
    table, scores = one(found, FUSION), several.measured.fusion
    assert scores is not None
    lines = list(csv.DictReader(io.StringIO(tidy(table.numbers))))
    keys = ["/".join(line[name] for name in ("quantity", "method", "cameras", "ground")) for line in lines]
    values = [float(line["mean"]) for line in lines]
    assert dict(zip(keys, values, strict=True)) == {at: band.value for at, band in scores.bands.items()}
    band = scores.band("depth_error_mm", "mode", 2)
    (row,) = [row for row in table.groups[0] if row.stub == ("depth (mm)", "Huber, mode")]
    assert row.cells[1].ours == f"{band.value:.{0 if band.value >= 100 else 1}f}"
    assert re.fullmatch(r"\(\d+(\.\d)?–\d+(\.\d)?\)", row.cells[1].spread)
    assert bold(table) == 0
    assert re.fullmatch(r"8[78]\.\d", table.groups[4][3].cells[0].below)
