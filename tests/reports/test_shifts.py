"""The matrix of shifts: every cell recomputed from the recorded tables, and where it appears."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from phd_exp.records.runs import RunFolder
from phd_exp.reports.files import all_tables, write_tables
from phd_exp.reports.runs import Report, read_report
from phd_exp.reports.shift_tables import shift_tables
from phd_exp.reports.site import build
from phd_exp.reports.terminal import print_report
from tests.support.synthetic import write_run

CHANGES = {
    "occl": "data.variant=occl",
    "far": "data.z_range=[5, 7]",
    "dark": "images.brightness=0.5",
    "f": "f_factor=2",
}
OVERCONFIDENCE = {"occl": 1.0, "far": 1.6, "dark": 6.0, "f": 0.2}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shifts")


@pytest.fixture(scope="module")
def runs(place: Path) -> list[RunFolder]:
    """Two runs with shifts, of which the second lacks two, and one without."""
    found = []
    for seed, data in enumerate(("default", "occl")):
        run = write_run(place / "runs", data, n=150)
        run.write_config(run.config() | {"camera": {"focal_length": "shown"}})
        run.shifts.mkdir()
        for name in list(CHANGES)[: 4 - 2 * seed]:
            other = write_run(place / f"{data}-{name}", data, n=120, overconfidence=OVERCONFIDENCE[name])
            table = pq.read_table(other.predictions).replace_schema_metadata({"shift": CHANGES[name]})
            pq.write_table(table, run.shift(name))
        found.append(run)
    write_run(place / "runs", "scale", "mae_vz", n=50)
    return found


@pytest.fixture(scope="module")
def report(runs: list[RunFolder], place: Path) -> Report:
    return read_report(place / "runs")


def test_every_cell_is_recomputed(runs: list[RunFolder], report: Report) -> None:
    tables = shift_tables(report)
    mains = [table for table in tables if table.reading != "details"]
    assert [table.columns for table in mains] == [("home", "occl"), ("home", "far"), ("home", "dark", "f")]
    for table in mains:
        assert [row.stub for row in table.rows] == [("default, shown", "seed0"), ("occl, shown", "seed0")]
        for run, row in zip(runs, table.rows, strict=True):
            for name, cell in zip(table.columns, row.cells, strict=True):
                file = run.predictions if name == "home" else run.shift(name)
                if not file.exists():
                    assert cell.ours == "–"
                    continue
                inside = (pd.read_parquet(file)["level"] <= 0.9).to_numpy()
                assert cell.ours == f"{100 * inside.mean():.1f}"
                resampled = np.random.default_rng(0).choice(inside, (4000, len(inside))).mean(1)
                low, high = np.quantile(resampled, [0.01, 0.99])
                if low > 0.9 or high < 0.9:
                    assert cell.tone == ("broken" if inside.mean() < 0.8 else "off")
                    assert cell.spread == ("↑" if low > 0.9 else "↓↓" if inside.mean() < 0.8 else "↓")
    cells = {name: cell for table in mains for name, cell in zip(table.columns, table.rows[0].cells, strict=True)}
    assert (cells["home"].tone, cells["dark"].spread, cells["f"].spread) == ("", "↓↓", "↑")
    assert "far: data.z_range=[5, 7]." in mains[1].notes


def test_each_score_has_a_matrix_and_one_csv_has_all(runs: list[RunFolder], report: Report, tmp_path: Path) -> None:
    tables = all_tables(report)
    folder = write_tables(report, tables, tmp_path)
    csv = pd.read_csv(folder / "shifts.csv")
    at = csv[(csv["data"] == "default") & (csv["shift"] == "dark")].set_index("quantity")
    frame = pd.read_parquet(runs[0].shift("dark"))
    assert at.loc["depth_error_mm", "value"] == pytest.approx(frame["depth_error_mm"].mean())
    assert at.loc["inside_50", "value"] == pytest.approx(100 * (frame["level"] <= 0.5).mean())
    assert (at["n"] == 120).all()
    assert {"nll", "depth_ence", "projected_ence", "depth_sharpness_mm", "inside_99"} <= set(at.index)
    stems = {table.stem for table in tables if table.kind == "shifts"}
    assert len(stems) == 3 * (csv["quantity"].nunique())
    for stem in stems:
        assert (folder / f"{stem}.md").exists()
    latex = (folder / "shifts-inside_90-small-images.tex").read_text()
    assert r"$\downarrow$" in latex


def test_the_terminal_prints_the_matrix_and_the_site_all(
    report: Report, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    print_report(report, all_tables(report))
    printed = capsys.readouterr().out
    assert "Inside the 90 % region (%) under shift" in printed
    assert "NLL (nats) under shift" not in printed
    page = build.write_site(report, all_tables(report), [], tmp_path).read_text()
    assert page.count('<td class="n broken">') == sum(
        cell.tone == "broken" for table in shift_tables(report) for row in table.rows for cell in row.cells
    )
    assert "NLL (nats) under shift" in page


def test_a_broken_table_is_a_note_of_its_run(runs: list[RunFolder], tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "runs" / runs[0].path.relative_to(runs[0].path.parents[3]))
    shutil.copytree(runs[0].path, run.path)
    run.shift("far").write_bytes(b"torn")
    (broken,) = read_report(tmp_path / "runs", tmp_path / "measured").runs
    assert (broken.state, broken.measured.shifts) == ("finished", {})
    assert any("far.parquet" in note for note in broken.notes)
    run.shift("far").unlink()
    (again,) = read_report(tmp_path / "runs", tmp_path / "measured").runs
    assert again.measured.shifts.keys() == {"home", "occl", "dark", "f"}, "measured again"
