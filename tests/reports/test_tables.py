"""The paper's tables: every number against a hand computation, bold cells, missing runs."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from phd_exp.reports.paper_tables import paper_tables
from phd_exp.reports.report import Report, read_report
from phd_exp.reports.table import Table, TableCell
from tests.support.recorded import DATA, ODD_PRESET, Predicted, both_tables, by_hand, fail, predicted, record

PAPER = {
    ("mae_vz", "occl", "projected"): 22.8,
    ("mae_logz", "scale", "depth"): 355,
    ("probabilistic", "occl_scale", "projected"): 17.0,
    ("mae_xyz", "default", "projected"): 13.0,
    ("mae_constf", "default", "depth"): 325,
}
"""Some of the paper's figures, copied independently."""


def one(found: list[Table], name: str, reading: str = "whole", preset: str = "small") -> Table:
    (table,) = [t for t in found if (t.lines["table"].iloc[0], t.reading, t.preset) == (name, reading, preset)]
    return table


def place(table: Table, model: str, data: str, quantity: str) -> TableCell:
    label = "probabilistic (mode)" if model == "probabilistic" else model
    if table.stub == ("model",):
        column, stub = table.columns.index(f"{quantity} error (mm)"), (label,)
    else:
        column, stub = table.columns.index(data), (label, quantity)
    (row,) = [row for row in table.rows if row.stub == stub]
    return row.cells[column]


Drawn = dict[tuple[str, str, int], Predicted]


@pytest.fixture(scope="module")
def drawn_and_report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Drawn, Report]:
    runs = tmp_path_factory.mktemp("runs")
    return both_tables(runs), read_report(runs)


@pytest.fixture(scope="module")
def found(drawn_and_report: tuple[Drawn, Report]) -> list[Table]:
    return paper_tables(drawn_and_report[1])


def expected(drawn: Drawn, line: dict) -> list[np.ndarray]:
    """Errors of the seeds of a number, by hand."""
    errors = []
    for seed in (0, 1):
        if (line["model"], line["data"], seed) in drawn:
            table = drawn[line["model"], line["data"], seed]
            inside = np.abs(table.v_p).max(axis=1) <= (1 if line["reading"] == "whole" else 0.5)
            quantity = line["quantity"].removesuffix("_error_mm")
            errors.append(by_hand(table, line["estimate"], quantity)[inside])
    return errors


def test_every_number_is_the_one_computed_by_hand(drawn_and_report: tuple, found: list[Table]) -> None:
    drawn, _ = drawn_and_report
    checked = 0
    for line in (line for table in found if table.preset == "small" for line in table.lines.to_dict("records")):
        errors = expected(drawn, line)
        if not errors:
            assert line["mean"] is None
            continue
        checked += 1
        means = [values.mean() for values in errors]
        assert line["mean"] == pytest.approx(np.mean(means), rel=1e-9)
        of_seeds = stats.t.ppf(0.975, 1) * abs(means[0] - means[-1]) / 2
        half_width = np.hypot(of_seeds, stats.norm.ppf(0.975) * np.mean([stats.sem(values) for values in errors]))
        assert (line["high"] - line["low"]) / 2 == pytest.approx(half_width, rel=1e-6)
        complete = len(errors) == 2
        assert (line["state"], line["n_test"]) == ("finished" if complete else "1 of 2 seeds", min(map(len, errors)))
        if line["published"]:
            assert line["ratio"] == pytest.approx(np.mean(means) / line["published"], rel=1e-9)
    # Table 1: 5 estimates on 4 data sets but one missing; Table 2: 5 on one; 2 errors in 2 readings
    assert checked == 2 * 2 * (5 * 4 - 1 + 5)


@pytest.mark.parametrize(("choice", "figure"), PAPER.items())
def test_the_papers_figures_stand_below(
    drawn_and_report: tuple, found: list[Table], choice: tuple[str, str, str], figure: float
) -> None:
    model, data, quantity = choice
    drawn, _ = drawn_and_report
    line = {"model": model, "data": data, "reading": "whole", "quantity": quantity, "estimate": "mode"}
    table = one(found, "table2" if model in ("mae_xyz", "mae_constf") else "table1")
    digits = 1 if quantity == "projected" else 0
    assert place(table, *choice).below == f"{figure:.{digits}f} (×{np.mean(expected(drawn, line)) / figure:.2f})"


def test_the_layout_is_the_papers(found: list[Table]) -> None:
    first, second = one(found, "table1"), one(found, "table2", "central")
    assert first.columns == DATA
    assert second.columns == ("projected error (mm)", "depth error (mm)")
    models, others, bounds = first.groups
    labels = ("mae_vz", "mae_logz", "probabilistic (mode)")
    assert [row.stub for row in models] == [(name, error) for name in labels for error in ("projected", "depth")]
    assert [row.stub[0] for row in others[::2]] == ["probabilistic (mean)", "probabilistic (median)"]
    assert [[cell.ours for cell in row.cells] for row in bounds] == [
        ["–", "–", "291", "–"],  # no bound is known on occl_scale
        ["–", "–", "336", "–"],
        ["500"] * 4,
    ]
    assert [row.stub[0] for row in second.groups[0]] == ["mae_xyz", "mae_constf", "probabilistic (mode)"]
    assert [cell.ours for cell in second.groups[2][0].cells] == ["–", "331"]
    for table in found:
        assert all(len(row.cells) == len(table.columns) for row in table.rows)
        assert all(len(row.stub) == len(table.stub) for row in table.rows)


def test_each_preset_has_its_own_tables(found: list[Table]) -> None:
    names = [(ODD_PRESET, "table2"), ("small", "table1"), ("small", "table2")]  # the first has no run of Table 1
    assert [(table.preset, table.lines["table"].iloc[0], table.reading) for table in found] == [
        (*name, reading) for name in names for reading in ("whole", "central")
    ]


MODELS = ("mae_vz", "mae_logz", "probabilistic")
EXTRA = dict.fromkeys(("mean_x", "mean_y", "mean_z", "mu_x", "mu_y", "median_z"), 4.0)


def read(runs: Path, name: str = "table1", reading: str = "whole", preset: str = "small") -> Table:
    return one(paper_tables(read_report(runs)), name, reading, preset)


def test_eight_views_have_a_line_if_they_are_recorded(tmp_path: Path) -> None:
    drawn = predicted(0)
    folders = [record(tmp_path, "default", "probabilistic", seed, drawn.frame) for seed in (0, 1)]
    names = [row.stub for row in read(tmp_path).rows]
    exact = drawn.frame.assign(
        mode_z=1.01 * drawn.frame["z"], **{f"mode_{axis}": 1.01 * drawn.frame[axis] for axis in "xy"}
    )
    exact.to_parquet(folders[0].eight_views["test"])
    table = read(tmp_path)
    added = [row for row in table.rows if row.stub not in names]
    assert [row.stub for row in added] == [("probabilistic (eight views)", error) for error in ("projected", "depth")]
    truth = drawn.frame[["x", "y", "z"]].to_numpy()
    assert added[0].cells[0].ours == "0.0"
    assert added[1].cells[0].ours == f"{10 * np.linalg.norm(truth, axis=1).mean():.0f}"
    assert "(seed 1): no eight views" in "".join(table.gaps)


def peripheral(drawn: Predicted) -> pd.DataFrame:
    """The samples outside the central half."""
    return drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)]


def test_bold_cells_are_separated_from_every_other_model_by_a_paired_test(tmp_path: Path) -> None:
    """Three seeds a model on the same images; the third model is worse by far, the first two are alike."""
    drawn = [predicted(0, noise=noise, probabilistic=False) for noise in (0.02, 0.02, 0.2)]
    for model, table in zip(MODELS, drawn, strict=True):
        for seed in range(3):
            scatter = np.random.default_rng([seed, len(model)]).normal(1, 1e-3, len(table.frame))
            columns = {name: table.frame[name] * scatter for name in ("mode_x", "mode_y", "mode_z")}
            for data in ("occl",) if model == "mae_logz" else ("occl", "scale"):
                record(tmp_path, data, model, seed, table.frame.assign(**columns, **EXTRA))
    found = read(tmp_path)
    for quantity in ("projected", "depth"):
        assert place(found, "mae_vz", "scale", quantity).bold
        assert not any(place(found, model, "occl", quantity).bold for model in MODELS)


def test_rows_and_columns_without_a_run_are_left_out_and_named(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 0, predicted(0).frame)
    table = read(tmp_path)
    assert table.columns == ("occl",)
    assert {row.stub[0].split()[0] for group in table.groups[:2] for row in group} == {"probabilistic"}
    assert "Left out of Table 1, without a run: default, scale, occl_scale, mae_vz, mae_logz." in table.notes
    assert (table.gaps, table.command) == ((), "")


@pytest.mark.parametrize(("focal_length", "bound"), [("known", 336), ("shown", 291)])
def test_means_below_their_bound_are_marked(tmp_path: Path, focal_length: str, bound: int) -> None:
    run = record(tmp_path, "scale", "probabilistic", 0, predicted(0, noise=0.001).frame)
    run.write_config({"camera": {"focal_length": focal_length}})
    table = read(tmp_path)
    assert table.lines.set_index(["estimate", "quantity"])["bound"]["mode", "depth_error_mm"] == bound
    assert place(table, "probabilistic", "scale", "depth").spread.endswith("†§")
    assert any(note.startswith("§") for note in table.notes)


def test_missing_runs_are_named_with_the_command_that_makes_them(found: list[Table]) -> None:
    table = one(found, "table1")
    assert [line.split(":")[0] for line in table.gaps] == ["mae_vz on scale (seed 1)"]
    assert place(table, "mae_logz", "occl", "depth").ours == "–", "nobody has begun it"
    assert place(table, "mae_vz", "scale", "depth").spread.endswith("†§‡")
    assert table.command.startswith("python -m phd_exp -m experiment=table1 preset=small seed=0,1 runs=")
    assert (one(found, "table2").gaps, one(found, "table2").command) == ((), "")


def test_every_state_is_named_in_its_cell(tmp_path: Path) -> None:
    record(tmp_path, "default", "mae_vz", 0)
    fail(tmp_path, "occl", "mae_vz")
    running = record(tmp_path, "scale", "mae_vz", 0)
    status = running.status()
    assert status is not None
    running.write_status(status.model_copy(update={"state": "running"}))
    record(tmp_path, "scale", "mae_logz", 0, peripheral(predicted(0)))
    with running.held():
        found = paper_tables(read_report(tmp_path))
    row = one(found, "table1").rows[0]
    assert [cell.ours for cell in row.cells] == ["unreadable", "failed", "running"]
    assert read(tmp_path).rows[0].cells[2].ours == "interrupted"
    assert place(one(found, "table1", "central"), "mae_logz", "scale", "depth").ours == "no sample"


def test_no_command_makes_central_samples(tmp_path: Path) -> None:
    for model in ("mae_xyz", "mae_constf", "probabilistic"):
        record(tmp_path, "default", model, 0, peripheral(predicted(0)))
    table = read(tmp_path, "table2", "central")
    assert all("none of its test samples lies in the central half" in line for line in table.gaps)
    assert table.command == ""


def test_a_recipe_has_its_own_tables_and_command(tmp_path: Path) -> None:
    title = "The paper's Table 1, preset small"
    for preset, titled, command in (
        ("small+strong", f"{title}, recipe strong: ", " experiment=table1 preset=small recipe=strong runs="),
        ("small", f"{title}: ", " experiment=table1 preset=small runs="),
    ):
        record(tmp_path, "occl", "mae_vz", 0, predicted(0, n=30).frame, preset=preset)
        record(tmp_path, "scale", "mae_vz", 0, preset=preset)
        table = read(tmp_path, preset=preset)
        assert table.title.startswith(f"{titled}the whole field of view")
        assert command in table.command


def test_the_title_has_the_number_of_test_samples(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0, n=30).frame)
    title = "The paper's Table 1, preset small: the whole field of view"
    assert read(tmp_path).title == f"{title}, 30 test samples"
    record(tmp_path, "occl", "mae_logz", 0, predicted(0, n=50).frame)
    assert read(tmp_path).title == f"{title}, 30 to 50 test samples"


def test_only_the_intervals_that_occur_are_explained(tmp_path: Path) -> None:
    for seed, (explained, other) in enumerate([("standard errors", "Student"), ("Student", "standard errors")]):
        record(tmp_path, "occl", "mae_vz", seed, predicted(seed).frame)
        notes = " ".join(read(tmp_path).notes)
        assert explained in notes
        assert other not in notes
