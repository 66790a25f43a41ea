"""Guarantees of held-out samples against the exact law of their coverage, another library, and fresh samples."""

import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from phd_exp.distributions import ProjectedHuber, Temperature
from phd_exp.distributions.columns import coordinates, from_columns, parameter_columns
from phd_exp.evaluation.conformal import GROUPED_BY, fused_guarantee, guarantee, threshold
from phd_exp.evaluation.predictions import fit_temperature
from phd_exp.evaluation.several_views import read_views
from phd_exp.fusion import fuse
from phd_exp.metrics.errors import squared_mahalanobis
from phd_exp.records.errors import RunError
from phd_exp.records.runs import choosing
from tests.support.several import write_views
from tests.support.synthetic import calibrated, truths

Table = dict[str, np.ndarray]
SPLITS = 3000


def scores_of(table: Table) -> np.ndarray:
    return predictions(table).level(torch.from_numpy(np.column_stack([table[axis] for axis in "xyz"]))).numpy()


def predictions(table: Table) -> ProjectedHuber:
    return from_columns({name: torch.from_numpy(column) for name, column in table.items()})


def table_of(n: int, seed: int, overconfidence: float = 1.0, of_wide: float = 1.0) -> Table:
    """Held-out samples whose predictions are too precise, by another factor for wide cameras (f < 1600 px)."""
    xyz, f = truths(n, seed)
    near, far = (calibrated(xyz, 40.0, 900.0, factor, seed) for factor in (overconfidence, overconfidence * of_wide))
    tables = [{k: v.numpy() for k, v in parameter_columns(p).items()} for p in (near, far)]
    mixed = {name: np.where(f < 1600, tables[1][name], tables[0][name]) for name in tables[0]}
    return mixed | {k: v.numpy() for k, v in coordinates("", xyz).items()} | {"f": f.numpy(), "S": np.full(n, 224.0)}


@cache
def overconfident() -> np.ndarray:
    """Sorted scores of too precise predictions."""
    return np.sort(scores_of(table_of(30_000, 0, overconfidence=1.5)))


@pytest.mark.parametrize(("n", "coverage"), [(9, 0.9), (40, 0.5), (500, 0.9), (199, 0.99)])
def test_the_coverage_of_random_splits_has_the_exact_law(n: int, coverage: float) -> None:
    """Given exchangeable samples of overconfident predictions, whatever their law."""
    random = np.random.default_rng(n)
    pool = overconfident()
    drawn = pool[random.integers(0, len(pool), (SPLITS, n))]
    levels = np.array([threshold(row, coverage, "samples") for row in drawn])
    covered = np.searchsorted(pool, levels, side="right") / len(pool)
    k = math.ceil(round((n + 1) * coverage, 9))
    assert stats.kstest(covered, stats.beta(k, n + 1 - k).cdf).pvalue > 1e-3
    error = 4 * stats.beta(k, n + 1 - k).std() / math.sqrt(SPLITS)
    assert coverage - error < covered.mean() < coverage + 1 / (n + 1) + error


@pytest.mark.parametrize("sizes", [[20] * 25, [1, 2, 40] * 8])
def test_a_sample_of_a_further_block_is_covered(sizes: list[int]) -> None:
    """Nine tenths of the variance are common to a block, as in a video. The rule for single samples covers less."""
    random, n = np.random.default_rng(0), len(sizes)
    block = np.repeat(np.arange(n), sizes)
    by_blocks, by_samples = [], []
    for _ in range(SPLITS):
        scores = 0.95 * random.standard_normal(n)[block] + 0.31 * random.standard_normal(len(block))
        by_blocks.append(threshold(scores, 0.9, "samples", block))
        by_samples.append(threshold(scores, 0.9, "samples"))
    covered, less = (stats.norm.cdf(found).mean() for found in (by_blocks, by_samples))
    assert less + 0.005 < 0.9 < covered < 0.9 + 1 / n
    with pytest.raises(RunError, match=r"needs at least 9 blocks \(track, scene or image\) of samples; found 8"):
        threshold(scores[block < 8], 0.9, "samples", block[block < 8])


@pytest.mark.parametrize("coverage", [0.5, 0.9, 0.95])
def test_one_dimensional_intervals_are_those_of_mapie(coverage: float) -> None:
    regression = pytest.importorskip("mapie.regression", reason="needs `pip install 'phd_exp[dev]'`")
    linear_model = pytest.importorskip("sklearn.linear_model")
    random = np.random.default_rng(0)
    x, noise = random.uniform(-1, 1, (300, 1)), random.standard_t(3, 300)
    y = x[:, 0] + noise
    model = linear_model.LinearRegression().fit(x[:100], y[:100])
    theirs = regression.SplitConformalRegressor(model, confidence_level=coverage).conformalize(x[100:], y[100:])
    _, interval = theirs.predict_interval(x[:5])
    ours = threshold(np.abs(y - model.predict(x))[100:], coverage, "samples")
    np.testing.assert_allclose(interval[:, :, 0], model.predict(x[:5])[:, None] + [-ours, ours])


@pytest.mark.parametrize(("coverage", "needed"), [(0.5, 1), (0.9, 9), (0.95, 19), (0.99, 99), (0.999, 999)])
def test_too_few_samples_are_an_error_with_the_number_needed(coverage: float, needed: int) -> None:
    scores = np.linspace(0.9, 0, needed)
    assert threshold(scores, coverage, "samples") == 0.9
    with pytest.raises(RunError, match=f"got {coverage}; needs at least {needed} samples; found {needed - 1}"):
        threshold(scores[1:], coverage, "samples")
    held_out = table_of(2 * needed, 1)
    assert guarantee(held_out, coverage, None, None).n == [needed]
    fewer = {name: column[:-1] for name, column in held_out.items()}
    with pytest.raises(RunError, match=rf"needs at least {needed} held-out samples, every second of data.n_held_out"):
        guarantee(fewer, coverage, None, None)
    with pytest.raises(RunError, match=rf"needs at least {needed} photographs; found {needed - 1}"):
        guarantee(fewer, coverage, None, None, "photographs")


@pytest.mark.parametrize("coverage", [0.0, 1.0, -1.0, 90.0, math.nan])
def test_a_coverage_is_between_0_and_1_and_scores_are_numbers(coverage: float) -> None:
    with pytest.raises(RunError, match=r"^coverage: got .*; expected a probability between 0 and 1"):
        threshold(np.ones(100), coverage, "samples")
    with pytest.raises(ValueError, match=r"^scores: got 1 that are not numbers"):
        threshold(np.array([0.5] * 20 + [math.nan]), 0.9, "samples")


@pytest.mark.parametrize("groups", GROUPED_BY)
@pytest.mark.parametrize("overconfidence", [0.5, 2.0])
def test_every_group_is_covered(groups: str | None, overconfidence: float) -> None:
    """Counts of fresh samples in their regions, within the law of the threshold and of counting."""
    found = guarantee(table_of(3000, 2, overconfidence, of_wide=1.5), 0.9, groups, None)  # type: ignore[arg-type]
    fresh = table_of(3000, 3, overconfidence, of_wide=1.5)
    p, f = predictions(fresh), torch.from_numpy(fresh["f"] / fresh["S"])
    place = np.searchsorted(found.edges, GROUPED_BY[groups](p, f).numpy(), side="right")  # type: ignore[index]
    assert len(found.levels) == (1 if groups is None else 4)
    scores = scores_of(fresh)
    for group, (level, n) in enumerate(zip(found.levels, found.n, strict=True)):
        part = scores[place == group]
        k = math.ceil((n + 1) * 0.9)
        low, high = stats.betabinom(len(part), k, n + 1 - k).ppf([1e-4, 1 - 1e-4])
        assert low <= (part <= level).sum() <= high


def test_one_threshold_for_all_misses_where_predictions_are_worse() -> None:
    held_out, fresh = (table_of(3000, seed, of_wide=2.0) for seed in (2, 3))
    (level,) = guarantee(held_out, 0.9, None, None).levels
    wide = fresh["f"] < 1600
    assert (scores_of(fresh) <= level).mean() == pytest.approx(0.9, abs=0.02)
    assert (scores_of(fresh)[wide] <= level).mean() < 0.85


def test_a_region_is_that_of_its_group() -> None:
    found = guarantee(table_of(4000, 2, of_wide=2.0), 0.9, "focal_length", None)
    fresh = table_of(1, 3)
    p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
    for place, f in enumerate([1250 / 224, 1500 / 224, 1700 / 224, 1900 / 224]):
        region, facts = found.region(p, f)
        low, high = facts["focal_length"]
        assert (low or 0) <= f < (high or 10)
        assert (facts["level"], facts["held_out_samples"]) == (region.level, found.n[place])
    assert found.levels[0] > found.levels[3] + 0.05
    equal = guarantee(table_of(400, 2) | {"f": np.full(400, 400.0)}, 0.9, "focal_length", None)
    assert equal.n == [200]
    assert equal.region(predictions(fresh).expand([1]), 1.0)[1]["focal_length"] == [None, None]


@pytest.mark.parametrize("blocks", [False, True])
def test_rows_that_choose_do_not_guarantee_and_the_others_choose_nothing(blocks: bool) -> None:
    table, other = table_of(800, 1), table_of(800, 2, overconfidence=1.2)

    def mixed(rows: np.ndarray) -> Table:
        changed = {name: column.copy() for name, column in table.items()}
        for name in changed:
            changed[name][rows] = other[name][rows]
        return changed

    if blocks:
        table["block"] = other["block"] = np.arange(800) // 20
    rows = choosing(table)
    assert rows.sum() == 400
    assert (np.diff(rows) != 0).sum() == (39 if blocks else 799)
    chosen, guaranteed = mixed(rows), mixed(~rows)
    temperature = fit_temperature(table, rows)
    assert fit_temperature(guaranteed, rows) == temperature != fit_temperature(chosen, rows)
    assert temperature != fit_temperature(table)
    before = guarantee(table, 0.9, "spread", None)
    np.testing.assert_array_equal(guarantee(guaranteed, 0.9, "spread", None).edges, before.edges)
    assert guarantee(chosen, 0.9, None, None).levels == guarantee(table, 0.9, None, None).levels
    assert guarantee(guaranteed, 0.9, None, None).levels != guarantee(table, 0.9, None, None).levels


def test_recalibrated_regions_have_their_own_threshold() -> None:
    table = table_of(2000, 1, overconfidence=2.0)
    before, after = (guarantee(table, 0.9, None, at).levels[0] for at in (None, fit_temperature(table)))
    assert before > 0.98
    assert after == pytest.approx(0.9, abs=0.03)


def test_samples_that_no_bounded_region_holds_are_an_error() -> None:
    table = table_of(200, 1, overconfidence=1e4)
    with pytest.raises(RunError, match="too many true positions have level 1; try recalibrate=true"):
        guarantee(table, 0.9, None, None)


@pytest.mark.parametrize("overconfidence", [1.0, 2.0])
def test_fused_ellipsoids_cover_scenes_that_did_not_guarantee(tmp_path: Path, overconfidence: float) -> None:
    write_views(tmp_path / "views.parquet", n=400, overconfidence=overconfidence)
    views = read_views(tmp_path / "views.parquet")
    for cameras in (2, 4):
        facts = fused_guarantee(tmp_path / "views.parquet", cameras, 0.9, None)
        fresh = views.cameras(cameras).subset(views.columns["scene"][:, 0] % 2 == 0)
        fused = fuse(fresh.predictions, fresh.pose)
        inside = squared_mahalanobis(fresh.truth - fused.mean, fused.covariance) <= facts["squared_mahalanobis"]
        n = facts["held_out_samples"]
        k = math.ceil((n + 1) * 0.9)
        low, high = stats.betabinom(fresh.n, k, n + 1 - k).ppf([1e-4, 1 - 1e-4])
        assert low <= int(inside.sum()) <= high
        exact = stats.chi2.ppf(0.9, 3)
        assert facts["squared_mahalanobis"] == pytest.approx(exact * overconfidence**2, rel=0.4)
    wider = fused_guarantee(tmp_path / "views.parquet", 4, 0.9, Temperature(4.0, 4.0))
    assert wider["squared_mahalanobis"] < facts["squared_mahalanobis"] / 6


def test_scenes_that_are_missing_or_too_few_are_an_error(tmp_path: Path) -> None:
    file = tmp_path / "views.parquet"
    with pytest.raises(RunError, match=r"views.parquet: no scenes with 2 cameras.*evaluation.multiview.scenes=500"):
        fused_guarantee(file, 2, 0.9, None)
    write_views(file, n=16)
    with pytest.raises(RunError, match="no scenes with 5 cameras"):
        fused_guarantee(file, 5, 0.9, None)
    with pytest.raises(RunError, match=r"needs at least 9 scenes, every second .*; found 8"):
        fused_guarantee(file, 2, 0.9, None)
    frame = pd.read_parquet(file)
    frame[frame["scene"] == 0].to_parquet(file)
    with pytest.raises(RunError, match=re.escape("needs at least 9 scenes")):
        fused_guarantee(file, 2, 0.9, None)
