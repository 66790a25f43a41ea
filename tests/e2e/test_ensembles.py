"""Seeds of a sweep and the eight views of each, from training to predictions and the report."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.predictions import ensemble_table
from phd_exp.records.runs import RunFolder, find_runs
from phd_exp.reports.files import write_tables
from phd_exp.reports.report import Report
from phd_exp.reports.runs import Run
from phd_exp.reports.tables import ensembles
from tests.support.synthetic import write_run
from tests.support.untrained import read_lines, write_photos

EIGHT = "evaluation.eight_views=true"


def report_of(runs: list[RunFolder]) -> Report:
    """Finished runs with a density, without their other measurements."""
    return Report(Path(), tuple(Run(run, *run.names, state="finished", nll=0.0) for run in runs))


@pytest.mark.slow
def test_two_seeds_and_their_eight_views(own: Callable, phd_exp: Callable, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    assert own("-m", "data.n_held_out=40", "seed=0,1").status == 0
    first, second = find_runs(Path("runs"))
    before = first.results()
    outcome = own("data.n_held_out=40", "seed=0", EIGHT)  # in the same folder: the run is finished already
    assert outcome.status == 0, outcome.err
    assert "finished already" in outcome.out
    results = first.results()
    assert results == before | {key: value for key, value in results.items() if key.startswith("eight_views/")}
    test, held_out = (read_table(first.eight_views[part]) for part in ("test", "held_out"))
    assert results["eight_views/nll"] == pytest.approx(test["nll"].mean())
    assert set(test) == {*read_table(first.predictions), "disagreement"}
    assert (len(test["nll"]), len(held_out["nll"])) == (16, 40)

    trust = "trust=ownnet"
    words = (f"run={first.path}", "views=8", trust, "folder=photos")
    for line in read_lines(phd_exp("predict", *words).out):
        assert 1 / 21 <= line["familiar"] <= 1
    for words in ((f"run={first.path.parent}", trust), (f"run={first.path},{second.path}", trust)):
        outcome = phd_exp("predict", *words, "folder=photos")
        assert (outcome.status, outcome.err) == (0, "")
        assert len(read_lines(outcome.out)) == 2

    (table,) = ensembles(report_of([first, second]))
    assert [row.stub[1] for row in table.rows] == ["one network", "2 seeds", "eight views, seed0"]


def test_a_table_of_one_two_three_and_five_seeds(tmp_path: Path) -> None:
    """Calibrated seeds with independent errors: their mixture is better and, by its spread, underconfident."""
    runs = [write_run(tmp_path, seed=seed, n=100) for seed in range(5)]
    runs += [write_run(tmp_path, n=20, overrides=("optimizer.lr=0.1",)), write_run(tmp_path, n=20, data="occl")]
    report = report_of(runs)
    (table,) = ensembles(report)
    assert [row.stub for row in table.rows] == [
        ("probabilistic on default", kind) for kind in ("one network", "2 seeds", "3 seeds", "5 seeds")
    ]
    folder = write_tables(report, [table], tmp_path / "report")
    rows = list(csv.DictReader((folder / "ensembles.csv").read_text().splitlines()))
    found = {(row["prediction"], row["quantity"]): float(row["value"]) for row in rows}
    tables = [read_table(run.predictions) for run in runs[:5]]
    assert found["one network", "nll"] == pytest.approx(np.mean([table["nll"].mean() for table in tables]))
    for k in (2, 3, 5):
        together = ensemble_table(tables[:k])
        assert found[f"{k} seeds", "nll"] == pytest.approx(together["nll"].mean())
        assert found[f"{k} seeds", "inside_90"] == pytest.approx(100 * (together["level"] <= 0.9).mean())
    assert found["5 seeds", "nll"] < found["one network", "nll"]
    assert found["5 seeds", "level"] < 0.5
    assert all(float(row["low"]) <= float(row["value"]) <= float(row["high"]) for row in rows)
