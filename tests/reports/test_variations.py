"""The contribution of single choices: every number by hand, and the runs that enter no table."""

from pathlib import Path

import pytest

from phd_exp.reports.runs import read_report
from phd_exp.reports.table import Table
from phd_exp.reports.variations import variation_tables
from tests.support.recorded import Predicted, by_hand, predicted, record

PLAIN, VARIED = (), ("optimizer.lr=0.5",)
SEEDS = (0, 1)


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
    plain = {(0.1, seed): held_out(tmp_path, PLAIN, seed, seed, noise=0.02) for seed in SEEDS}
    return plain | {(0.5, seed): held_out(tmp_path, VARIED, seed, 10 + seed, noise=0.04) for seed in SEEDS}


def only(runs: Path) -> Table:
    (table,) = variation_tables(read_report(runs))
    return table


def test_numbers_are_of_the_held_out_images_that_choose(drawn: dict, tmp_path: Path) -> None:
    (plain,), (varied,) = only(tmp_path).groups
    assert only(tmp_path).stem == "variations-small-occl-probabilistic"
    assert plain.stub == ("none", "0, 1")
    assert varied.stub == ("optimizer.lr=0.5", "0, 1")
    for row, lr in ((plain, 0.1), (varied, 0.5)):
        nll = [drawn[lr, seed].frame["nll"][::2].mean() for seed in SEEDS]
        projected = [by_hand(drawn[lr, seed], "mode", "projected")[::2].mean() for seed in SEEDS]
        depth = [by_hand(drawn[lr, seed], "mode", "depth")[::2].mean() for seed in SEEDS]
        for cell, values, digits in zip(row.cells, (nll, projected, depth), (2, 1, 0), strict=False):
            assert cell.ours == f"{sum(values) / 2:.{digits}f}"
            assert cell.spread == f"({min(values):.{digits}f} to {max(values):.{digits}f})"


def test_a_difference_is_between_runs_of_the_same_seed(drawn: dict, tmp_path: Path) -> None:
    held_out(tmp_path, VARIED, 2, 12, noise=0.3)  # a seed without a counterpart
    (plain,), (varied,) = only(tmp_path).groups
    nll = {key: table.frame["nll"][::2].mean() for key, table in drawn.items()}
    differences = [nll[0.5, seed] - nll[0.1, seed] for seed in SEEDS]
    assert varied.stub[1] == "0, 1, 2"
    assert varied.cells[3].ours == f"{sum(differences) / 2:+.2f}"
    assert varied.cells[3].spread == f"({min(differences):+.2f} to {max(differences):+.2f})"
    assert plain.cells[3].ours == ""


def test_baselines_are_compared_by_depth_error(tmp_path: Path) -> None:
    plain, varied = (
        held_out(tmp_path, words, 0, number, noise, model="mae_vz")
        for number, (words, noise) in enumerate([(PLAIN, 0.02), (VARIED, 0.04)])
    )
    cells = only(tmp_path).groups[1][0].cells
    before, now = (by_hand(table, "mode", "depth")[::2].mean() for table in (plain, varied))
    assert (cells[0].ours, cells[3].ours) == ("–", f"{100 * (now / before - 1):+.0f}")


def test_the_best_comes_first(drawn: dict, tmp_path: Path) -> None:
    folder = record(tmp_path, "occl", "probabilistic", 0, predicted(5).frame, overrides=("recipe.localisation=2",))
    frame = predicted(20).frame
    frame["nll"] = -9.0
    frame.to_parquet(folder.held_out)
    assert [row.stub[0] for row in only(tmp_path).groups[1]] == ["recipe.localisation=2", "optimizer.lr=0.5"]


@pytest.mark.parametrize("broken", ["held_out", "state"])
def test_unfinished_and_unreadable_runs_are_left_out(drawn: dict, tmp_path: Path, broken: str) -> None:
    for run in read_report(tmp_path).runs:
        if run.overrides:
            file = run.folder.held_out if broken == "held_out" else run.folder.status_file
            file.write_bytes(b"torn")
    assert variation_tables(read_report(tmp_path)) == []
