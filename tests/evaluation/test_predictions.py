"""The evaluation of tables whose calibration is known."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import coordinates, distribution_columns, draws
from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.predictions import (
    ERRORS,
    OF_DISTANCE,
    Evaluation,
    evaluate,
    fit_temperature,
    recalibrated,
)  # fmt: skip
from phd_exp.evaluation.volumes import drawn_columns
from phd_exp.metrics.calibration import calibration_curve
from phd_exp.metrics.calibration_scores import exact_scores
from phd_exp.metrics.errors import depth_error, projected_error
from phd_exp.records.errors import RunError
from phd_exp.reports.quantities import SCORES

N = 1000


def predictions(n: int) -> tuple[ProjectedHuber, np.ndarray]:
    generator = torch.Generator().manual_seed(1)
    raw = torch.randn(n, 7, generator=generator, dtype=torch.float64)
    raw[:, 2:6] = 8 + 20 * raw[:, 2:6].abs()
    raw[:, 3] = 0
    f = 1200 + 800 * torch.rand(n, generator=generator, dtype=torch.float64)
    return ProjectedHuber.from_raw(raw, f=f, S=224.0, mu_z0=2.5e-3), f.numpy()


@pytest.fixture(scope="module")
def table() -> Callable[..., dict[str, np.ndarray]]:
    """The columns of `predictions.parquet` for predictions that are `overconfidence` times too precise."""
    truth, f = predictions(N)
    xyz = draws(truth, 1, seed=2)[0]

    def columns(overconfidence: float = 1.0) -> dict[str, np.ndarray]:
        claim = truth.tempered(1 / overconfidence, 1 / overconfidence)
        values = coordinates("", xyz) | coordinates("mode_", claim.mode) | distribution_columns(claim, xyz)
        values["projected_error_mm"] = 1000 * projected_error(xyz, claim.mode)
        values["depth_error_mm"] = 1000 * depth_error(xyz, claim.mode)
        values["ale_m"] = (claim.mode.norm(dim=-1) - xyz.norm(dim=-1)).abs()
        values["relative_error"] = 100 * values["ale_m"] / xyz.norm(dim=-1)
        values |= drawn_columns(claim, xyz, seed=3)
        visibility = np.linspace(0, 1, N)
        visibility[:10] = math.nan
        known = {"file_name": np.array([f"{i}.png" for i in range(N)]), "f": f, "visibility": visibility}
        return known | {name: column.numpy() for name, column in values.items()}

    return columns


@pytest.fixture(scope="module")
def perfect(table: Callable) -> Evaluation:
    return evaluate(table(), resamples=20)


def test_scores_are_those_of_the_metrics(perfect: Evaluation, table: Callable) -> None:
    columns = table()
    assert perfect.scores.keys() <= SCORES.keys()
    exact = exact_scores({name: torch.from_numpy(columns[name]) for name in columns if name != "file_name"})
    assert exact.pop("left_out") == perfect.left_out == 0
    means = {name: columns[name].mean() for name in (*ERRORS, *OF_DISTANCE, "nll")}
    for name, value in (exact | means).items():
        assert perfect.scores[name].value == pytest.approx(value), name
    assert perfect.scores["energy_score_mm"].value == pytest.approx(1000 * columns["energy_score"].mean())
    for name, band in perfect.scores.items():
        assert band.low <= band.value <= band.high, name
        assert band.low < band.high, name


def test_curves_of_calibrated_predictions_are_the_identity(perfect: Evaluation) -> None:
    for name in ("coverage", "depth_pit"):
        curve = perfect.curves[name]
        assert (curve.x[0], curve.x[-1], curve.y[-1]) == (0, 1, 1)
        np.testing.assert_allclose(curve.y, curve.x, atol=0.06)
    for name in ("depth_calibration", "projected_calibration"):
        curve = perfect.curves[name]
        assert 100 <= len(curve.x) < 202
        # the squared errors of one window of 200 scatter by a fifth
        np.testing.assert_allclose(np.log(np.array(curve.y) / curve.x), 0, atol=0.7)
        assert np.mean((np.array(curve.low) < curve.x) & (np.array(curve.x) < curve.high)) > 0.5


def test_calibration_curve_is_the_papers(perfect: Evaluation, table: Callable) -> None:
    variance, error = (torch.from_numpy(table()[f"depth_{name}"]) for name in ("variance", "squared_error"))
    expected = calibration_curve(variance, error, window=200)
    stride = len(expected.predicted) // 100
    np.testing.assert_allclose(perfect.curves["depth_calibration"].x, expected.predicted[::stride])
    np.testing.assert_allclose(perfect.curves["depth_calibration"].y, expected.empirical[::stride])


def test_risk_falls_with_the_share_kept(perfect: Evaluation, table: Callable) -> None:
    curve = perfect.curves["projected_risk_coverage"]
    assert curve.y[-1] == pytest.approx(1000 * np.sqrt(table()["projected_squared_error"]).mean())
    assert curve.y[20] < 0.8 * curve.y[-1]


def test_every_sample_is_in_one_stratum_of_each_quantity(perfect: Evaluation) -> None:
    assert {part.quantity for part in perfect.strata} == {"visibility", "depth", "focal length"}
    for quantity in ("visibility", "depth", "focal length"):
        parts = [part for part in perfect.strata if part.quantity == quantity]
        assert sum(part.n for part in parts) == perfect.n == N
        mean = sum(part.n * part.scores["nll"].value for part in parts) / N
        assert mean == pytest.approx(perfect.scores["nll"].value)
    assert "visibility unknown" in [part.label for part in perfect.strata]
    assert any(part.label.endswith(" px") for part in perfect.strata)


def test_temperatures_mend_what_is_overconfident(table: Callable, perfect: Evaluation) -> None:
    over = table(2.0)
    temperature = fit_temperature(over)
    assert temperature.projected == pytest.approx(2, rel=0.1)
    assert temperature.depth == pytest.approx(2, rel=0.1)
    mended = recalibrated(over, temperature)
    assert mended.keys() == over.keys()
    after = evaluate(mended, resamples=20)
    assert after.scores["nll"].value == pytest.approx(perfect.scores["nll"].value, abs=0.02)
    assert after.scores["miscalibration_area"].value < 0.03
    assert after.scores["energy_score_mm"].value == pytest.approx(perfect.scores["energy_score_mm"].value, rel=0.02)
    for name in ("projected_error_mm", "mode_z", "file_name", "f"):
        np.testing.assert_array_equal(mended[name], over[name])


def test_a_column_without_values_is_unknown(table: Callable, tmp_path: Path) -> None:
    points = {name: table()[name] for name in ("z", "projected_error_mm", "depth_error_mm")}
    pq.write_table(pa.table(points | {"visibility": pa.nulls(N)}), tmp_path / "points.parquet")
    unknown = evaluate(read_table(tmp_path / "points.parquet"), resamples=5).strata
    assert [part.label for part in unknown if part.quantity == "visibility"] == ["visibility unknown"]


def test_points_have_errors_alone(table: Callable, perfect: Evaluation) -> None:
    columns = {name: table()[name] for name in ("z", "f", "projected_error_mm", "depth_error_mm")}
    points = evaluate(columns, resamples=20)
    assert points.scores.keys() == {"projected_error_mm", "depth_error_mm"}
    assert points.scores["depth_error_mm"] == perfect.scores["depth_error_mm"]
    assert points.curves == points.reference == {}
    assert {part.quantity for part in points.strata} == {"depth", "focal length"}


def test_samples_that_are_not_finite_are_left_out(table: Callable) -> None:
    columns = table()
    columns["depth_variance"] = np.where(np.arange(N) < 3, np.inf, columns["depth_variance"])
    found = evaluate(columns, resamples=2)
    assert (found.n, found.left_out) == (N - 3, 3)
    columns["a"] = np.where(np.arange(N) < 4, np.nan, columns["a"])
    assert len(recalibrated(columns, fit_temperature(columns))["nll"]) == N - 4


@pytest.mark.parametrize("missing", ["depth_pit", "energy_score", "nll", "depth_error_mm"])
def test_a_missing_column_is_one_line(table: Callable, missing: str) -> None:
    columns = {name: column for name, column in table().items() if name != missing}
    with pytest.raises(RunError, match=f"^predictions: no column {missing}, as .*; run the model again$"):
        evaluate(columns)


def test_what_cannot_be_measured_is_one_line(table: Callable) -> None:
    columns = table()
    temperature = fit_temperature(columns)
    with pytest.raises(RunError, match="none of 1000 samples has finite"):
        evaluate(columns | {"nll": np.full(N, np.nan)})
    with pytest.raises(RunError, match="none of 1000 samples has finite"):
        recalibrated(columns | {"a": np.full(N, np.nan)}, temperature)
    with pytest.raises(RunError, match="parameters are of no distribution"):
        recalibrated(columns | {"a": -columns["a"]}, temperature)
    with pytest.raises(RunError, match="no temperature fits"):
        fit_temperature(columns | {"z": -columns["z"]})
