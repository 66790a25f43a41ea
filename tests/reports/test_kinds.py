"""Each kind of table except the paper's: its numbers against ones computed by hand, and what it leaves out."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch

from phd_exp.evaluation.predictions import OF_A_DISTRIBUTION, XYZ, evaluation_of
from phd_exp.evaluation.tracks import ERRORS, METHODS
from phd_exp.metrics.bootstrap import means
from phd_exp.records.runs import RunFolder
from phd_exp.reports.report import Report, read_report
from phd_exp.reports.runs import Run
from phd_exp.reports.site import build
from phd_exp.reports.site.run_charts import run_charts
from phd_exp.reports.table import Table
from phd_exp.reports.tables import fusion, heads, other_tables, shifts, tracks, variations
from tests.support.recorded import Predicted, by_hand, predicted, record
from tests.support.sequences import ERRORS as SLOW_ERRORS
from tests.support.sequences import write_sequences
from tests.support.several import write_views
from tests.support.synthetic import write_run


def rows(table: Table) -> dict[tuple[str, ...], tuple]:
    return {row.stub: row.cells for row in table.rows}


# densities


@pytest.fixture(scope="module")
def densities(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Three seeds of four densities on the same images, whose NLL differ and whose levels are uniform."""
    runs = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        for model, nll in (("probabilistic", -3.0), ("gaussian", -2.0), ("mine", -3.0), ("better", -4.0)):
            frame = predicted(0).frame
            random = np.random.default_rng([seed, len(model)])
            for name in OF_A_DISTRIBUTION[len(XYZ) :]:
                frame[name] = random.uniform(0, 1, len(frame))
            frame["nll"] = nll + 0.01 * random.standard_normal(len(frame))
            frame["level"] = (np.arange(len(frame)) + 0.5) / len(frame)
            record(runs, "default", model, seed, frame)
    record(runs, "default", "mae_vz", 0, predicted(1, probabilistic=False).frame)
    report = read_report(runs)
    return replace(report, runs=tuple(map(_with_pairs, report.runs)))


def _with_pairs(run: Run) -> Run:
    """Two models have scores of pairs of cameras."""
    error = {"probabilistic": 50.0, "gaussian": 80.0}.get(run.model)
    column = torch.linspace(0.5, 1.5, 20).double() * (error or 0)
    pairs = evaluation_of(means, {"fused_error_mm": column}, 0, 10) if error else None
    return replace(run, measured=replace(run.measured, pairs=pairs))


def test_densities_are_compared_with_the_probabilistic_model(densities: Report) -> None:
    (table,) = heads(densities)
    found = {row.stub[0]: row for row in table.rows}
    assert list(found) == ["probabilistic", "better", "gaussian", "mine"]
    assert [row.stub[1:] for row in table.rows] == [
        ("–", "0, 1, 2"), ("–", "0, 1, 2"), ("3, 6", "0, 1, 2"), ("–", "0, 1, 2"),
    ]  # fmt: skip
    assert found["probabilistic"].cells[0].ours == "−3.00"
    assert found["gaussian"].cells[0].below.startswith("+1.00 ±0.0")
    assert {name: row.cells[0].bold for name, row in found.items()} == {
        "probabilistic": False, "better": True, "gaussian": False, "mine": False,
    }  # fmt: skip
    coverage = table.columns.index("Inside the 90 % region (%)")
    assert (found["mine"].cells[coverage].ours, found["mine"].cells[coverage].bold) == ("90.0", False)
    # every seed of two models has recorded several views
    assert table.columns[-1] == "Fused error of two cameras (mm)"
    assert [found[name].cells[-1].ours for name in ("probabilistic", "gaussian", "mine")] == ["50.0", "80.0", "–"]
    lines = table.lines[(table.lines["model"] == "gaussian") & (table.lines["quantity"] == "nll")]
    assert lines["value"].mean() == pytest.approx(-2, abs=0.01)


@pytest.mark.parametrize(
    ("kept", "better"),
    [
        (lambda model, seed: model != "better" or seed == 0, False),
        (lambda model, seed: model == "probabilistic", None),
        (lambda model, seed: model != "probabilistic", None),
    ],
    ids=["one seed is never better", "a single density", "no reference"],
)
def test_what_is_not_compared(densities: Report, kept: Callable[[str, int], bool], better: bool | None) -> None:
    some = Report(Path(), tuple(run for run in densities.runs if kept(run.model, run.seed or 0)))
    found = [rows(table) for table in heads(some)]
    assert [cells[0].bold for table in found for stub, cells in table.items() if stub[0] == "better"] == (
        [] if better is None else [better]
    )
    assert len(found) == (better is not None)


# shifts

CHANGES = {
    "occl": "data.variant=occl",
    "far": "data.z_range=[5, 7]",
    "dark": "images.brightness=0.5",
    "f": "f_factor=2",
}
OVERCONFIDENCE = {"occl": 1.0, "far": 1.6, "dark": 6.0, "f": 0.2}


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> list[RunFolder]:
    """Two runs with shifts, of which the second lacks two, and one without."""
    place, found = tmp_path_factory.mktemp("shifts"), []
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


def test_every_cell_of_the_shifts_is_recomputed(shifted: list[RunFolder]) -> None:
    tables = list(shifts(read_report(shifted[0].path.parents[3])))
    mains = [table for table in tables if table.reading != "details"]
    assert [table.columns for table in mains] == [("home", "occl"), ("home", "far"), ("home", "dark", "f")]
    seen = set()
    for table in mains:
        for run, row in zip(shifted, table.rows, strict=False):
            assert row.stub == (f"{run.names[1]}, shown", "seed0")
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
                    seen.add(cell.spread)
                    assert cell.tone == ("broken" if inside.mean() < 0.8 else "off")
                    assert cell.spread == ("↑" if low > 0.9 else "↓↓" if inside.mean() < 0.8 else "↓")
    assert {"↑", "↓↓"} <= seen
    assert "far: data.z_range=[5, 7]." in mains[1].notes
    lines = pd.concat([table.lines for table in tables])
    at = lines[(lines["data"] == "default") & (lines["shift"] == "dark")].set_index("quantity")
    frame = pd.read_parquet(shifted[0].shift("dark"))
    assert at.loc["depth_error_mm", "value"] == pytest.approx(frame["depth_error_mm"].mean())
    assert (at["n"] == 120).all()
    assert len({table.stem for table in tables}) == 3 * lines["quantity"].nunique()


def test_a_broken_table_of_a_shift_is_a_note_of_its_run(shifted: list[RunFolder], tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "runs" / shifted[0].path.relative_to(shifted[0].path.parents[3]))
    shutil.copytree(shifted[0].path, run.path)
    run.shift("far").write_bytes(b"torn")
    (broken,) = read_report(tmp_path / "runs", tmp_path / "measured").runs
    assert (broken.state, broken.measured.shifts) == ("finished", {})
    assert any("far.parquet" in note for note in broken.notes)
    run.shift("far").unlink()
    (again,) = read_report(tmp_path / "runs", tmp_path / "measured").runs
    assert again.measured.shifts.keys() == {"home", "occl", "dark", "f"}, "measured again"


# variations

PLAIN, VARIED = (), ("optimizer.lr=0.5",)


def held_out(
    runs: Path, overrides: tuple[str, ...], seed: int, number: int, noise: float, model: str = "probabilistic"
) -> Predicted:
    """A finished run with these predictions of its held-out images, and others of its test images."""
    probabilistic = model == "probabilistic"
    tested = predicted(1000 + number, noise=1, probabilistic=probabilistic).frame
    folder = record(runs, "occl", model, seed, tested, overrides=overrides)
    drawn = predicted(number, noise=noise, probabilistic=probabilistic)
    drawn.frame.to_parquet(folder.held_out)
    return drawn


@pytest.fixture
def drawn(tmp_path: Path) -> dict[tuple[float, int], Predicted]:
    plain = {(0.1, seed): held_out(tmp_path, PLAIN, seed, seed, noise=0.02) for seed in (0, 1)}
    return plain | {(0.5, seed): held_out(tmp_path, VARIED, seed, seed, noise=0.04) for seed in (0, 1)}


def test_variations_are_judged_on_the_held_out_images_that_choose(drawn: dict, tmp_path: Path) -> None:
    held_out(tmp_path, VARIED, 2, 12, noise=0.3)  # a seed without a counterpart
    (table,) = variations(read_report(tmp_path))
    assert table.stem == "variations-small-occl-probabilistic"
    (plain,), (varied,) = table.groups
    assert (plain.stub, varied.stub) == (("none", "0, 1"), ("optimizer.lr=0.5", "0, 1, 2"))
    nll, projected, depth = (
        np.mean([of(drawn[0.1, seed]) for seed in (0, 1)])
        for of in (
            lambda one: one.frame["nll"][::2].mean(),
            lambda one: by_hand(one, "mode", "projected")[::2].mean(),
            lambda one: by_hand(one, "mode", "depth")[::2].mean(),
        )
    )
    assert [cell.ours for cell in plain.cells[:3]] == [
        f"{nll:.2f}".replace("-", "−"), f"{projected:.1f}", f"{depth:.{0 if depth >= 100 else 1}f}",
    ]  # fmt: skip
    gaps = [(drawn[0.5, s].frame["nll"][::2] - drawn[0.1, s].frame["nll"][::2]).mean() for s in (0, 1)]
    assert float(varied.cells[3].ours.replace("−", "-")) == pytest.approx(np.mean(gaps), abs=0.006)
    assert plain.cells[3].ours == "–"


def test_variations_of_baselines_are_judged_by_depth_and_the_best_comes_first(tmp_path: Path) -> None:
    words = {PLAIN: 0.03, VARIED: 0.04, ("recipe.localisation=2",): 0.01}
    made = [held_out(tmp_path, word, 0, 3, noise, model="mae_vz") for word, noise in words.items()]
    (table,) = variations(read_report(tmp_path))
    assert [row.stub[0] for row in table.rows] == ["none", "recipe.localisation=2", "optimizer.lr=0.5"]
    plain, varied = (by_hand(one, "mode", "depth")[::2].mean() for one in made[:2])
    cell = table.rows[2].cells[table.columns.index("difference")]
    assert float(cell.ours.replace("−", "-")) == pytest.approx(varied - plain, abs=0.6)
    assert "NLL (nats)" not in table.columns


@pytest.mark.parametrize("broken", ["held_out", "state"])
def test_variations_leave_unreadable_runs_out(drawn: dict, tmp_path: Path, broken: str) -> None:
    for run in read_report(tmp_path).runs:
        if run.overrides:
            file = run.folder.held_out if broken == "held_out" else run.folder.status_file
            file.write_bytes(b"torn")
    assert list(variations(read_report(tmp_path))) == []


# several cameras and paths


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Report:
    folder = tmp_path_factory.mktemp("several")
    run = write_run(folder, "occl", n=40, epochs=1)
    write_views(run.views, 24, a=30.0, common=0.1)
    for is_held_out in (False, True):
        write_sequences(
            run.sequence(8, held_out=is_held_out), 5, 8, cameras=1 + is_held_out, errors=SLOW_ERRORS,
            seed=int(is_held_out),
        )  # fmt: skip
    write_sequences(run.sequence(12, held_out=False), 3, 12, cameras=2, seed=5)
    return read_report(folder)


def test_cells_of_fusion_and_paths_are_the_scores(several: Report) -> None:
    (run,) = several.runs
    (of_cameras,), (of_paths,) = fusion(several), tracks(several)
    scores = run.measured.fusion
    assert scores is not None
    keys = of_cameras.lines[["quantity", "method", "cameras", "ground"]].agg("/".join, axis=1)
    assert dict(zip(keys, of_cameras.lines["mean"], strict=True)) == {
        at: one.value for at, one in scores.bands.items()
    }
    band = scores.band("depth_error_mm", "mode", 2)
    cell = rows(of_cameras)["Depth error (mm)", "Huber, mode"][1]
    assert cell.ours == f"{band.value:.{0 if band.value >= 100 else 1}f}"
    assert float(rows(of_cameras)["Inside the 90 % ellipsoid (%)", "Huber, mean"][0].below) == pytest.approx(
        88, abs=1
    )
    assert of_paths.columns == ("5 × 8 frames", "3 × 12 frames", "3 × 12 frames, 2 cameras")
    found = {tuple(line[:4]): line[4:] for line in of_paths.lines.iloc[:, 4:11].itertuples(index=False, name=None)}
    for one in run.measured.tracks.values():
        for name in (*ERRORS, "nees"):
            for method in METHODS:
                band = one.bands[f"{name}/{method}"]
                assert found[one.frames, one.cameras, name, method] == (band.value, band.low, band.high)
    assert f"{run.measured.tracks['8'].hidden} of 40 frames" in " ".join(of_paths.notes)


def test_charts_and_pages_of_paths_and_cameras(several: Report, tmp_path: Path) -> None:
    charts = run_charts(several.runs[0])
    names = [f"tracks_{quantity}_{key}" for key in ("8", "12", "12_2") for quantity in (*ERRORS, "nees")]
    assert list(charts["tracks"]) == names
    band, *traces = charts["tracks"]["tracks_nees_8"].data
    assert band["meta"]["low"][0] < 1 < band["meta"]["high"][0]
    assert [len(trace["x"]) for trace in traces] == [8] * len(METHODS)
    assert len(charts["fusion"]) == 5
    build.write_site(several, list(other_tables(several)), [], tmp_path)
    page, overview = next((tmp_path / "runs").glob("*.html")).read_text(), (tmp_path / "index.html").read_text()
    for kind, text in (("tracks", "ours, weighted frames"), ("fusion", "Huber, mode")):
        assert f'<section id="{kind}"' in page
        assert text in page
        assert f"#{kind}" in overview


@pytest.mark.parametrize("cameras", [1, 2])
def test_sequences_without_held_out_ones_of_as_many_cameras_are_noted(tmp_path: Path, cameras: int) -> None:
    run = write_run(tmp_path, n=20, epochs=1)
    write_sequences(run.sequence(8, held_out=False), 2, 8, cameras=cameras)
    if cameras > 1:
        write_sequences(run.sequence(8, held_out=True), 2, 8)
    (found,) = read_report(tmp_path).runs
    assert not found.measured.tracks
    words = " from 2 cameras" if cameras > 1 else ""
    assert any(f"no held-out sequences{words};" in note for note in found.notes)
