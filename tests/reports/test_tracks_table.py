"""The table, the charts and the pages of a run with sequences."""

from pathlib import Path

import pytest

from phd_exp.evaluation.tracks import ERRORS, METHODS
from phd_exp.reports.files import all_tables, markdown
from phd_exp.reports.runs import Report, read_report
from phd_exp.reports.site.build import write_site
from phd_exp.reports.site.run_charts import run_charts
from tests.support.sequences import ERRORS as SLOW_ERRORS
from tests.support.sequences import write_sequences
from tests.support.synthetic import write_run


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    folder = tmp_path_factory.mktemp("tracks")
    run = write_run(folder, "occl", n=40, epochs=1)
    for held_out in (False, True):
        cameras = 1 + held_out
        write_sequences(
            run.sequence(8, held_out=held_out), 8, 8, cameras=cameras, errors=SLOW_ERRORS, seed=int(held_out)
        )
    write_sequences(run.sequence(12, held_out=False), 3, 12, cameras=2, seed=5)
    return read_report(folder)


def test_the_table_holds_the_scores_of_each_length(report: Report) -> None:
    (run,) = report.runs
    (table,) = (one for one in all_tables(report) if one.kind == "tracks")
    assert table.columns == ("8 × 8 frames", "3 × 12 frames", "3 × 12 frames, 2 cameras")
    lines = {(line["frames"], line["cameras"], line["quantity"], line["method"]): line for line in table.numbers}
    for scores in run.measured.tracks.values():
        which = scores.frames, scores.cameras
        for key, band in scores.bands.items():
            quantity, _, method = key.rpartition("/")
            if (line := lines.get((*which, quantity, method))) is not None:
                assert (line["mean"], line["low"], line["high"]) == (band.value, band.low, band.high)
        assert {(*which, name, method) for name in (*ERRORS, "nees") for method in METHODS} <= lines.keys()
    text = markdown(table)
    assert f"{run.measured.tracks['8'].hidden} of 64 frames" in text


def test_every_length_has_its_charts_over_time(report: Report) -> None:
    charts = run_charts(report.runs[0])["tracks"]
    quantities = (*ERRORS, "nees")
    assert list(charts) == [f"tracks_{quantity}_{key}" for key in ("8", "12", "12_2") for quantity in quantities]
    chart = charts["tracks_nees_8"]
    band, *traces = chart.data
    assert band["meta"]["low"][0] < 1 < band["meta"]["high"][0]
    assert len(traces) == len(METHODS)
    assert all(len(trace["x"]) == 8 for trace in traces)


def test_the_pages_have_a_section_of_paths(report: Report, tmp_path: Path) -> None:
    write_site(report, all_tables(report), [], tmp_path)
    page = next((tmp_path / "runs").glob("*.html")).read_text()
    assert '<section id="tracks"' in page
    assert "ours, weighted frames" in page
    assert "#tracks" in (tmp_path / "index.html").read_text()


@pytest.mark.parametrize("cameras", [1, 2])
def test_tested_sequences_without_held_out_ones_of_as_many_cameras_are_noted(tmp_path: Path, cameras: int) -> None:
    run = write_run(tmp_path, n=20, epochs=1)
    write_sequences(run.sequence(8, held_out=False), 2, 8, cameras=cameras)
    if cameras > 1:
        write_sequences(run.sequence(8, held_out=True), 2, 8)
    (found,) = read_report(tmp_path).runs
    assert not found.measured.tracks
    several = " from 2 cameras" if cameras > 1 else ""
    assert any(f"no held-out sequences{several};" in note for note in found.notes)
