"""The table of densities: means, paired differences and bold cells against a computation by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phd_exp.evaluation.fusion import two_cameras
from phd_exp.evaluation.predictions import OF_A_DISTRIBUTION, XYZ
from phd_exp.evaluation.several_views import read_views
from phd_exp.reports.heads_table import COLUMNS, heads_tables
from phd_exp.reports.runs import Report, Run, read_report
from phd_exp.reports.site.pages import overview_page
from tests.support.recorded import predicted, record
from tests.support.several import write_views


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Three seeds of four densities on the same images, whose NLL differ and whose levels are uniform."""
    runs = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        for model, nll in (("probabilistic", -3.0), ("gaussian", -2.0), ("mine", -3.0), ("better", -4.0)):
            frame = predicted(0).frame
            random = np.random.default_rng(seed)
            for name in OF_A_DISTRIBUTION[len(XYZ) :]:
                frame[name] = random.uniform(0, 1, len(frame))
            frame["nll"] = nll + 0.01 * random.standard_normal(len(frame))
            frame["level"] = (np.arange(len(frame)) + 0.5) / len(frame)
            record(runs, "default", model, seed, frame)
    record(runs, "default", "mae_vz", 0, predicted(1, probabilistic=False).frame)
    return read_report(runs)


def test_densities_are_compared_with_the_probabilistic_model(report: Report) -> None:
    (table,) = heads_tables(report)
    assert [row.stub[0] for row in table.rows] == ["probabilistic", "better", "gaussian", "mine"]
    assert {row.stub[2] for row in table.rows} == {"0, 1, 2"}
    assert [row.stub[1] for row in table.rows] == ["–", "–", "3, 6", "–"]
    nll, coverage = (COLUMNS.index(name) for name in ("nll", "inside_90"))
    reference, _, gaussian, mine = (row.cells for row in table.rows)
    assert reference[nll].ours == "−3.00"
    assert gaussian[nll].below.startswith("+1.00 ±0.0")
    assert not gaussian[nll].bold
    assert not mine[nll].bold
    assert mine[coverage].ours == "90.0"
    of_nll = [line["value"] for line in table.numbers if (line["model"], line["quantity"]) == ("gaussian", "nll")]
    assert np.mean(of_nll) == pytest.approx(-2, abs=0.01)


def test_fused_errors_stand_beside_where_every_seed_has_recorded_several_views(
    report: Report, tmp_path: Path
) -> None:
    pairs = {}
    for model, a in (("probabilistic", 30.0), ("gaussian", 10.0)):
        write_views(tmp_path / model, 40, a=a)
        pairs[model] = two_cameras(read_views(tmp_path / model))
    runs = (replace(run, measured=replace(run.measured, pairs=pairs.get(run.model))) for run in report.runs)
    (table,) = heads_tables(replace(report, runs=tuple(runs)))
    cells = {row.stub[0]: row.cells[-1] for row in table.rows}
    assert table.columns[-1] == "Fused error of two cameras (mm)"
    assert cells["mine"].ours == "–"
    assert cells["gaussian"].below.startswith("+")
    assert float(cells["gaussian"].ours) > float(cells["probabilistic"].ours) > 0


def test_the_overview_has_the_table(report: Report) -> None:
    (table,) = heads_tables(report)
    for kind in ("heads", "ensembles"):
        page = overview_page(report.runs, [replace(table, kind=kind)], {}, [])
        assert f'<section id="of-{kind}"' in page
        assert page.count(f'href="#of-{kind}"') == 1
        assert table.title in page


def test_a_better_density_is_bold_with_several_seeds_only(report: Report) -> None:
    def is_bold(report: Report) -> bool:
        (table,) = heads_tables(report)
        return next(row.cells[0].bold for row in table.rows if row.stub[0] == "better")

    assert is_bold(report)
    one_seed = tuple(run for run in report.runs if run.model != "better" or run.seed == 0)
    assert not is_bold(replace(report, runs=one_seed))


def test_runs_with_the_same_overrides_have_a_table_of_their_own(report: Report) -> None:
    def with_overrides(run: Run) -> Run:
        moved = run.model in ("probabilistic", "gaussian") and run.seed in (0, 1)
        return replace(run, name=f"{run.name}-0123abcd") if moved else run

    plain, changed = heads_tables(replace(report, runs=tuple(map(with_overrides, report.runs))))
    assert [row.stub[0] for row in changed.rows] == ["probabilistic", "gaussian"]
    assert {row.stub[2] for row in changed.rows} == {"0, 1"}
    assert changed.title == f"{plain.title}, overrides 0123abcd"
    assert {line["overrides"] for line in changed.numbers} == {"0123abcd"}


def test_a_single_density_has_no_table(tmp_path: Path) -> None:
    record(tmp_path, "default", "probabilistic", 0, predicted(0).frame)
    assert heads_tables(read_report(tmp_path)) == []
