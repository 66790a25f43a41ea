"""The paper's tables: every number against a hand computation, what is best, what is not there."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from phd_exp.reports.cells import Cell
from phd_exp.reports.collect import collect
from phd_exp.reports.tables import PaperTable, TableCell, tables
from tests.reports.recorded import DATA, ODD_PRESET, Predicted, both_tables, by_hand, fail, predicted, record

PAPER = {
    ("mae_vz", "occl", "projected"): 22.8,
    ("mae_logz", "scale", "depth"): 355,
    ("probabilistic", "occl_scale", "projected"): 17.0,
    ("mae_xyz", "default", "projected"): 13.0,
    ("mae_constf", "default", "depth"): 325,
}
"""Some of the paper's figures, typed once more."""


def one(found: list[PaperTable], name: str, reading: str = "whole", preset: str = "small") -> PaperTable:
    (table,) = [t for t in found if (t.name, t.reading, t.preset) == (name, reading, preset)]
    return table


def place(table: PaperTable, model: str, data: str, quantity: str, estimate: str = "mode") -> TableCell:
    (found,) = [
        cell
        for row in table.rows
        for cell in row.cells
        if cell.source
        and (cell.source.model, cell.source.data) == (model, data)
        and (cell.source.key.quantity, cell.source.key.estimate) == (quantity, estimate)
    ]
    return found


@pytest.fixture(scope="module")
def drawn_and_found(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[dict[tuple[str, str, int], Predicted], list[PaperTable]]:
    runs = tmp_path_factory.mktemp("runs")
    return both_tables(runs), tables(collect(runs))


def expected(drawn: dict[tuple[str, str, int], Predicted], cell: Cell) -> list[float]:
    """Mean errors of a cell's seeds, by hand."""
    means = []
    for seed in (0, 1):
        if (cell.model, cell.data, seed) in drawn:
            table = drawn[cell.model, cell.data, seed]
            inside = np.abs(table.v_p).max(axis=1) <= (1 if cell.key.reading == "whole" else 0.5)
            means.append(float(by_hand(table, cell.key.estimate, cell.key.quantity)[inside].mean()))
    return means


def test_every_number_is_the_one_computed_by_hand(drawn_and_found: tuple) -> None:
    drawn, found = drawn_and_found
    checked = 0
    for table in (table for table in found if table.preset == "small"):
        for cell in table.sources:
            means = expected(drawn, cell)
            if not means:
                assert cell.mean is None
                continue
            checked += 1
            assert cell.mean == pytest.approx(np.mean(means), rel=1e-9)
            assert cell.interval is not None
            if len(means) == 2:
                half_width = stats.t.ppf(0.975, 1) * abs(means[0] - means[1]) / 2
                assert cell.interval.half_width == pytest.approx(half_width, rel=1e-6)
            if cell.published:
                assert cell.ratio == pytest.approx(np.mean(means) / cell.published, rel=1e-9)
    # Table 1: 5 estimates on 4 data sets but one missing; Table 2: 5 on one; 2 errors in 2 readings
    assert checked == 2 * 2 * (5 * 4 - 1 + 5)


@pytest.mark.parametrize(("choice", "figure"), PAPER.items())
def test_the_papers_figures_stand_beside(
    drawn_and_found: tuple, choice: tuple[str, str, str], figure: float
) -> None:
    drawn, found = drawn_and_found
    name = "table2" if choice[0] in ("mae_xyz", "mae_constf") else "table1"
    cell = place(one(found, name), *choice)
    assert cell.source is not None
    ratio = np.mean(expected(drawn, cell.source)) / figure
    digits = 1 if choice[2] == "projected" else 0
    assert cell.paper == f"{figure:.{digits}f} (×{ratio:.2f})"


def test_the_layout_is_the_papers(drawn_and_found: tuple) -> None:
    _, found = drawn_and_found
    first, second = one(found, "table1"), one(found, "table2", "central")
    assert first.columns == DATA
    assert second.columns == ("projected error (mm)", "depth error (mm)")
    models, others, floors = first.groups
    assert [row.stub for row in models] == [
        (model, quantity)
        for model in ("mae_vz", "mae_logz", "probabilistic (mode)")
        for quantity in ("projected", "depth")
    ]
    assert [row.stub[0] for row in others[::2]] == ["probabilistic (mean)", "probabilistic (median)"]
    assert [cell.ours for cell in floors[0].cells] == ["–", "–", "291", "≥ 291"]
    assert [row.stub for row in second.groups[0]] == [
        ("mae_xyz",),
        ("mae_constf",),
        ("probabilistic (mode)",),
    ]
    assert [cell.ours for cell in second.groups[2][0].cells] == ["–", "331"]
    for table in found:
        assert all(len(row.cells) == len(table.columns) for row in table.rows)
        assert all(len(row.stub) == len(table.stub) for row in table.rows)


def test_presets_have_tables_of_their_own(drawn_and_found: tuple) -> None:
    _, found = drawn_and_found
    assert [(table.preset, table.name, table.reading) for table in found] == [
        (ODD_PRESET, "table2", "whole"),  # of Table 1 it has nothing
        (ODD_PRESET, "table2", "central"),
        ("small", "table1", "whole"),
        ("small", "table1", "central"),
        ("small", "table2", "whole"),
        ("small", "table2", "central"),
    ]


def test_the_best_of_a_column_is_bold(drawn_and_found: tuple) -> None:
    _, found = drawn_and_found
    for table in (table for table in found if table.preset == "small"):
        for data in {cell.data for cell in table.sources}:
            for quantity in ("projected", "depth"):
                column = [
                    place
                    for row in table.rows
                    for place in row.cells
                    if place.source
                    and (place.source.data, place.source.key.quantity) == (data, quantity)
                    and place.source.mean is not None
                ]
                least = min(float(place.ours) for place in column)
                assert [place.bold for place in column] == [float(place.ours) == least for place in column]
                assert any(place.bold for place in column)


def test_what_prints_alike_is_bold_alike_and_no_more(tmp_path: Path) -> None:
    frame = predicted(0, probabilistic=False).frame
    record(tmp_path, "occl", "mae_vz", 0, frame)
    record(tmp_path, "occl", "mae_logz", 0, frame.assign(mode_z=frame["mode_z"] * (1 + 1e-9)))
    worse = predicted(0, noise=0.2)
    record(tmp_path, "occl", "probabilistic", 0, worse.frame)
    table = one(tables(collect(tmp_path)), "table1")
    for quantity in ("projected", "depth"):
        cells = [place(table, model, "occl", quantity) for model in ("mae_vz", "mae_logz", "probabilistic")]
        assert cells[0].source != cells[1].source
        assert [cell.bold for cell in cells] == [True, True, False]


def test_one_model_alone_is_not_the_best(tmp_path: Path) -> None:
    record(tmp_path, "occl", "probabilistic", 0, predicted(0).frame)
    (table, *_) = tables(collect(tmp_path))
    assert sum(cell.ours not in ("missing", "–") for row in table.groups[0] for cell in row.cells) == 2
    assert not any(cell.bold for row in table.rows for cell in row.cells)


def test_what_is_not_there_is_named_with_the_command_that_makes_it(drawn_and_found: tuple) -> None:
    _, found = drawn_and_found
    table = one(found, "table1")
    assert [(gap.model, gap.data, gap.seed, gap.state) for gap in table.gaps] == [
        ("mae_vz", "scale", 1, "failed"),
        ("mae_logz", "occl", 0, "missing"),
        ("mae_logz", "occl", 1, "missing"),
    ]
    assert place(table, "mae_logz", "occl", "depth").ours == "missing"
    assert place(table, "mae_vz", "scale", "depth").spread.endswith("†‡")
    assert table.command.startswith("python -m phd_exp -m experiment=table1 preset=small seed=0,1 runs=")
    assert one(found, "table2").gaps == ()
    assert one(found, "table2").command == ""


def test_every_state_is_named_in_its_cell(tmp_path: Path) -> None:
    record(tmp_path, "default", "mae_vz", 0)
    fail(tmp_path, "occl", "mae_vz")
    running = record(tmp_path, "scale", "mae_vz", 0)
    status = running.status()
    assert status is not None
    running.write_status(status.model_copy(update={"state": "running"}))
    drawn = predicted(0)
    record(tmp_path, "scale", "mae_logz", 0, drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)])
    with running.held():
        found = tables(collect(tmp_path))
    row = one(found, "table1").rows[0]
    assert [cell.ours for cell in row.cells] == ["unreadable", "failed", "running", "missing"]
    assert one(tables(collect(tmp_path)), "table1").rows[0].cells[2].ours == "broken off"
    assert place(one(found, "table1", "central"), "mae_logz", "scale", "depth").ours == "no sample"


def test_no_run_helps_where_no_sample_is_central(tmp_path: Path) -> None:
    drawn = predicted(0)
    frame = drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)]
    for model in ("mae_xyz", "mae_constf", "probabilistic"):
        record(tmp_path, "default", model, 0, frame)
    table = one(tables(collect(tmp_path)), "table2", "central")
    assert {gap.state for gap in table.gaps} == {"no sample"}
    assert table.command == ""


def test_overrides_never_enter(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame, overrides=("optimizer.lr=0.5",))
    assert tables(collect(tmp_path)) == []
    record(tmp_path, "occl", "mae_vz", 1, predicted(1).frame)
    table = one(tables(collect(tmp_path)), "table1")
    cell = place(table, "mae_vz", "occl", "depth").source
    assert cell is not None
    assert cell.seeds == (1,)


def test_a_small_interval_does_not_print_as_nothing(tmp_path: Path) -> None:
    frame = predicted(0, probabilistic=False).frame
    record(tmp_path, "occl", "mae_vz", 0, frame)
    record(tmp_path, "occl", "mae_vz", 1, frame.assign(mode_z=frame["mode_z"] * (1 + 1e-6)))
    record(tmp_path, "occl", "mae_logz", 0, frame)
    record(tmp_path, "occl", "mae_logz", 1, frame)
    table = one(tables(collect(tmp_path)), "table1")
    spread = place(table, "mae_vz", "occl", "depth").spread
    assert float(spread.removeprefix("±")) > 0
    assert place(table, "mae_logz", "occl", "depth").spread == "±0"  # two seeds that are equal


def test_a_recipe_has_tables_of_its_own_and_a_command_that_makes_what_they_lack(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0, n=30).frame, preset="small+strong")
    record(tmp_path, "occl", "mae_vz", 0, predicted(0, n=30).frame)
    found = tables(collect(tmp_path))
    strong = one(found, "table1", preset="small+strong")
    assert strong.title.startswith("Table 1, preset small, recipe strong: the whole field of view")
    assert " experiment=table1 preset=small recipe=strong runs=" in strong.command
    plain = one(found, "table1")
    assert plain.title.startswith("Table 1, preset small: ")
    assert " recipe=" not in plain.command


def test_the_number_of_test_samples_is_said(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0, n=30).frame)
    (whole, *_) = tables(collect(tmp_path))
    assert whole.title == "Table 1, preset small: the whole field of view, 30 test samples"
    record(tmp_path, "occl", "mae_logz", 0, predicted(0, n=50).frame)
    (whole, *_) = tables(collect(tmp_path))
    assert whole.title.endswith(", 30 to 50 test samples")


def test_only_the_kinds_of_interval_that_occur_are_explained(tmp_path: Path) -> None:
    record(tmp_path, "occl", "mae_vz", 0, predicted(0).frame)
    (table, *_) = tables(collect(tmp_path))
    said = " ".join(table.notes)
    assert "standard errors" in said
    assert "Student" not in said
    record(tmp_path, "occl", "mae_vz", 1, predicted(1).frame)
    (table, *_) = tables(collect(tmp_path))
    said = " ".join(table.notes)
    assert "standard errors" not in said
    assert "Student" in said
