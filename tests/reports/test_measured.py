"""Stored measurements hold until a version is raised, so a version is raised when a number changes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from phd_exp.reports.measured import VERSIONS, Measured, kept_or_measured
from phd_exp.reports.report import read_report
from tests.support.sequences import write_sequences
from tests.support.several import write_views
from tests.support.synthetic import write_run

STORED = {
    "before": (4, {"all": 26, "nll": -6.64295, "nees": 12.4995, "depth_ence": 0.866212}),
    "after": (6, {"all": 25, "nll": -7.58325, "nees": 3.30439}),
    "fusion": (1, {"all": 176, "depth_error_mm/mode/2/free": 14.1506, "coverage_90/gaussian/4/ground": 71.95}),
    "pairs": (1, {"all": 1, "fused_error_mm": 23.2213}),
    "tracks": (4, {"all": 38, "depth_error_mm/single": 199.206, "nees/slow": 0.53718}),
    "gallery": (2, {"all": 2, "best": 42.5, "worst": 42.19}),
    "scene": (1, {"all": 2, "mode_z": 3.7408, "extent_90": 1.7036}),
    "shifts": (1, {"all": 29, "inside_90": 93.75, "unfamiliar": 100.0}),
}
"""Measurement -> its version, its count of numbers, and some of them. If one changes, raise the version, store it."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    folder = tmp_path_factory.mktemp("measured")
    run = write_run(folder, n=120, epochs=1, overconfidence=2.0)
    write_run(folder / "elsewhere", seed=1, n=400, overconfidence=2.0).predictions.rename(run.held_out)
    write_views(run.views, 50)
    for held_out in (False, True):
        write_sequences(run.sequence(10, held_out=held_out), 6, 10, seed=int(held_out))
    run.shifts.mkdir()
    write_run(folder / "shifted", "occl", n=80).predictions.rename(run.shift("occl"))
    return read_report(folder).runs[0].measured


def numbers(found: Measured) -> Iterator[tuple[str, dict[str, float]]]:
    for name in ("before", "after", "pairs"):
        yield name, {key: band.value for key, band in getattr(found, name).scores.items()}
    assert found.fusion is not None
    assert found.gallery is not None
    yield "fusion", {key: band.low for key, band in found.fusion.bands.items()}
    yield "tracks", {key: band.value for key, band in found.tracks["10"].bands.items()}
    yield "shifts", {key: band.high for key, band in found.shifts["occl"].scores.items()}
    assert found.scene is not None
    z = [position[2] for position in found.scene.regions[1][0]]
    yield "scene", {"mode_z": found.scene.mode[2], "extent_90": max(z) - min(z)}
    yield "gallery", {"best": found.gallery.best[0].panel.mode[0], "worst": found.gallery.worst[0].panel.truth[1]}


@pytest.mark.parametrize("name", STORED)
def test_a_number_that_changes_has_a_new_version(found: Measured, name: str) -> None:
    version, stored = STORED[name]
    now = dict(numbers(found))[name]
    now["all"] = len(now)  # a further score needs a new version too
    assert (VERSIONS[name], {key: now[key] for key in stored}) == (version, pytest.approx(stored, rel=1e-3))


def test_a_new_version_measures_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, times = write_run(tmp_path / "runs", "occl", "mae_vz", n=4, epochs=1), []

    def measuring() -> Measured:
        times.append(len(times))
        return Measured()

    for version in (1, 1, 2):
        monkeypatch.setitem(VERSIONS, "gallery", version)
        kept_or_measured(run, {}, measuring, tmp_path)
    assert len(times) == 2
