"""Tables and pictures from records alone."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.runs import RunFolder, RunName
from phd_exp.reports.collect import collect
from phd_exp.reports.figures import draw_calibration
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.tables import print_table


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    finished = RunFolder(RunName("small", "occl", "probabilistic", 0).folder(tmp_path))
    finished.path.mkdir(parents=True)
    with finished.recording(data_manifest=None):
        finished.write_results(
            {"test/projected_error_mm": 12.34, "test/depth_error_mm": 167.8, "test/nll": -1.234}
        )
    failed = RunFolder(RunName("small", "occl", "mae_vz", 0).folder(tmp_path))
    failed.path.mkdir(parents=True)
    with pytest.raises(ValueError, match="odd"), failed.recording(data_manifest=None):
        raise ValueError("odd\nnumber")
    broken = RunFolder(RunName("small", "scale", "mae_vz", 0).folder(tmp_path))
    broken.path.mkdir(parents=True)
    broken.status_file.write_text("{")
    return tmp_path


def test_a_row_a_run_whatever_its_state(runs: Path) -> None:
    failed, finished, broken = collect(runs)
    assert (finished.model, finished.projected_error_mm, finished.nll) == ("probabilistic", 12.34, -1.234)
    assert finished.published == PUBLISHED["probabilistic", "occl"]
    assert failed.state == "failed: ValueError: odd number"
    assert failed.projected_error_mm is None
    assert broken.state.startswith("broken: ")
    assert "status.json" in broken.state


def test_the_table_says_it_all(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_table(collect(runs))
    out = capsys.readouterr().out
    (line,) = [line for line in out.splitlines() if "probabilistic" in line]
    assert " ".join(line.split()) == "small occl probabilistic seed0 12.3 13.0 168 168 -1.23 finished"


def test_a_killed_run_does_not_look_alive(tmp_path: Path) -> None:
    run = RunFolder(RunName("small", "occl", "mae_vz", 0).folder(tmp_path))
    with run.held():
        with run.recording(data_manifest=None):
            status = run.status()
        assert status is not None
        run.write_status(status)  # as a SIGKILL would have left it
        assert [row.state for row in collect(tmp_path)] == ["running"]
    assert [row.state for row in collect(tmp_path)] == ["broken off; the same command goes on"]


def test_no_runs_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_table(collect(tmp_path))
    assert capsys.readouterr().out == "no runs recorded yet\n"


def test_published_numbers_cover_both_tables() -> None:
    assert len(PUBLISHED) == 14


def test_a_calibration_picture_has_ink(tmp_path: Path) -> None:
    predicted = np.geomspace(1e-4, 1e-1, 50)
    curve = {
        "predicted": predicted.tolist(),
        "empirical": (2 * predicted).tolist(),
        "window": 200,
        "left_out": 0,
    }
    draw_calibration({"depth": curve, "projected": curve}, tmp_path / "curve.png")
    with Image.open(tmp_path / "curve.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert (np.abs(pixels - (31, 119, 180)).max(axis=-1) < 30).sum() > 300  # the curves, blue
    assert (np.abs(pixels - (214, 39, 40)).max(axis=-1) < 90).sum() > 100  # the identities, red and thin
