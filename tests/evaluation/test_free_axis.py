"""Records of densities with a free axis, and with a rounded mode: read wherever those of the paper's density are."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from phd_exp.distributions import ProjectedHuber, Temperature
from phd_exp.distributions.columns import FREE_AXIS, ROUNDING, coordinates, distribution_columns
from phd_exp.evaluation import reference
from phd_exp.evaluation.conformal import guarantee
from phd_exp.evaluation.familiar import Familiarity
from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.predictions import at_temperature, ensemble_table, evaluate, fit_temperature, recalibrated
from phd_exp.evaluation.several_views import read_views
from phd_exp.fusion import fuse
from phd_exp.records.errors import RunError
from phd_exp.reports.gallery import curves_of
from tests.support.several import write_views

N = 400


@pytest.fixture(scope="module", params=[0.0, 2.0], ids=["free axis", "rounded mode"])
def predicted(request: pytest.FixtureRequest) -> ProjectedHuber:
    raw = torch.randn(N, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    raw[:, 2:6] = 8 + 20 * raw[:, 2:6].abs()
    raw[:, 3] = 0
    return ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3).with_rounding(request.param)


@pytest.fixture(scope="module")
def table(predicted: ProjectedHuber) -> dict[str, np.ndarray]:
    """Truths drawn from the predictions themselves."""
    xyz = predicted.rsample((), torch.Generator().manual_seed(1))
    columns = coordinates("", xyz) | coordinates("mode_", predicted.mode) | distribution_columns(predicted, xyz)
    one = torch.ones(N, dtype=torch.float64)
    columns |= {"f": 1500 * one, "S": 224 * one, "energy_score": one}
    columns |= {"projected_error_mm": one, "depth_error_mm": one}
    return {name: column.numpy() for name, column in columns.items()}


def test_a_calibrated_model_scores_as_one(table: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference, "_DRAWS", 80_000)  # as many as 400 samples need at least
    found = evaluate(table, resamples=20)
    for name in ("nees", "inside_90", "depth_pit_ks"):
        band = found.reference[name]
        room = (band.high - band.low) / 4  # to three deviations
        assert band.low - room <= found.scores[name].value <= band.high + room, name
    temperature = fit_temperature(table)
    assert (temperature.projected, temperature.depth) == pytest.approx((1, 1), abs=0.15)


def test_a_temperature_keeps_the_axis(table: dict[str, np.ndarray], predicted: ProjectedHuber) -> None:
    changed = recalibrated(table, Temperature(projected=2.0, depth=4.0))
    for name in FREE_AXIS:
        np.testing.assert_allclose(changed[name], 2 * table[name])  # k a over the projected temperature
    read = at_temperature(changed, None)[0]
    torch.testing.assert_close(read.apex, predicted.apex)
    assert read.rounding == predicted.rounding


def test_an_ensemble_of_equal_members_is_each_of_them(table: dict[str, np.ndarray]) -> None:
    mixed = ensemble_table([table, table])
    for name in ("mu_x", "mu_z", *FREE_AXIS):
        np.testing.assert_allclose(mixed[name], table[name], rtol=1e-4, atol=1e-4)
    for name in {"k_y", ROUNDING} & set(table):
        lacking = {key: column for key, column in table.items() if key != name}
        for tables in ([table, lacking], [lacking, table]):
            with pytest.raises(RunError, match=f"no column {name}"):
                ensemble_table(tables)


def test_familiarity_guarantees_and_pictures_read_it(table: dict[str, np.ndarray], predicted: ProjectedHuber) -> None:
    familiarity = Familiarity(table)
    assert np.mean(familiarity.p_value(familiarity.distance(table)) < 0.5) == pytest.approx(0.5, abs=0.1)
    region, _ = guarantee(table, 0.9, None, None).region(predicted[0], 1500 / 224)
    assert region.level == pytest.approx(0.9, abs=0.06)
    curves = curves_of({name: column[0] for name, column in table.items()})
    assert curves is not None
    np.testing.assert_allclose(curves.mode, predicted.mode[0], rtol=1e-6)


def test_several_views_of_it_are_fused(tmp_path: Path) -> None:
    write_views(file := tmp_path / "views.parquet", n=20)
    columns = dict(read_table(file))
    paper = read_views(file)
    for k, rounding in ((np.zeros(80), 0.0), (np.linspace(-1, 1, 80), 0.0), (np.zeros(80), 2.0)):
        known = {name: column for name, column in columns.items() if name != "file_name"}
        pq.write_table(pa.table(known | {"k_x": k, "k_y": -k, "rounding": np.full(80, rounding)}), file)
        views = read_views(file)
        assert views.predictions.k is not None
        assert views.predictions.rounding == rounding
        fused = fuse(views.predictions, views.pose)
        same = fuse(paper.predictions, paper.pose)
        assert fused.errors() == []
        assert torch.equal(fused.point, same.point) == bool((k == 0).all() and not rounding)
