"""Scores of paths on sequences whose motion and slow errors are known, and against formulas of their own."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from phd_exp.evaluation.several_views import SeveralViews, read_sequences
from phd_exp.evaluation.tracks import (
    HIDDEN,
    METHODS,
    SMOOTHERS,
    Choice,
    TrackScores,
    choose,
    correlated,
    place,
    track_scores,
)
from phd_exp.records.errors import RunError
from tests.support.sequences import ERRORS, MOTION, SLOW, write_sequences

N, FRAMES = 60, 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sequences")


@pytest.fixture(scope="module")
def independent(folder: Path) -> SeveralViews:
    write_sequences(folder / "independent.parquet", N, FRAMES)
    return read_sequences(folder / "independent.parquet")[0]


@pytest.fixture(scope="module")
def known() -> Choice:
    return Choice(dict.fromkeys(SMOOTHERS, MOTION.noise), MOTION.speed, SLOW, SLOW)


@pytest.fixture(scope="module")
def scores(independent: SeveralViews, known: Choice) -> TrackScores:
    return track_scores([independent], known, resamples=50)


@pytest.fixture(scope="module")
def slow(folder: Path, known: Choice) -> TrackScores:
    write_sequences(folder / "slow.parquet", N, FRAMES, errors=ERRORS, seed=1)
    return track_scores(read_sequences(folder / "slow.parquet"), known, resamples=50)


def value(scores: TrackScores, quantity: str, method: str) -> float:
    return scores.bands[f"{quantity}/{method}"].value


def test_independent_errors_are_calibrated_by_every_method_that_assumes_them(scores: TrackScores) -> None:
    for method in ("single", "independent"):
        assert value(scores, "nees", method) == pytest.approx(1, abs=0.15)
    assert value(scores, "nees", "slow") < value(scores, "nees", "independent"), "slow errors are too careful here"


def test_slow_errors_are_calibrated_if_frames_have_weights_and_overconfident_if_not(slow: TrackScores) -> None:
    assert value(slow, "nees", "slow") == pytest.approx(1, abs=0.35)
    assert slow.bands["nees/independent"].low > 1.5
    assert slow.bands["nees/kalman"].low > 1.5


def test_paths_have_smaller_errors_than_single_frames(scores: TrackScores) -> None:
    for method in SMOOTHERS:
        assert scores.bands[f"ratio/depth_error_mm/{method}"].high < 0.8
        ratio = value(scores, "depth_error_mm", method) / value(scores, "depth_error_mm", "single")
        assert value(scores, "ratio/depth_error_mm", method) == pytest.approx(ratio)
        hidden = value(scores, "hidden/depth_error_mm", method) / value(scores, "hidden/depth_error_mm", "single")
        assert value(scores, "ratio/hidden/depth_error_mm", method) == pytest.approx(hidden)
    gain = value(scores, "depth_error_mm", "kalman") - value(scores, "depth_error_mm", "independent")
    assert value(scores, "gain", "independent") == pytest.approx(gain)


def test_single_frames_have_the_recorded_errors(independent: SeveralViews, scores: TrackScores, folder: Path) -> None:
    table = pd.read_parquet(folder / "independent.parquet")
    hidden = table[table.visibility < HIDDEN]
    assert scores.hidden == len(hidden)
    for name in ("depth_error_mm", "projected_error_mm"):
        assert value(scores, name, "single") == pytest.approx(table[name].mean(), rel=1e-6)
        assert value(scores, f"hidden/{name}", "single") == pytest.approx(hidden[name].mean(), rel=1e-6)
        curve = scores.curves[place(name, "single")]
        np.testing.assert_allclose(curve.y, table.groupby("time")[name].mean(), rtol=1e-6)
        np.testing.assert_allclose(curve.x, np.arange(FRAMES) / 30)
    assert {key.rpartition("/")[2] for key in scores.curves} == set(METHODS)


def test_the_interval_of_calibrated_frames_is_that_of_draws(scores: TrackScores) -> None:
    drawn = np.random.default_rng(0).standard_normal((20000, N, 3))
    inside = (drawn**2).sum((1, 2)) / (3 * N)
    np.testing.assert_allclose(np.quantile(inside, [0.025, 0.975]), scores.calibrated, rtol=0.02)


def test_two_cameras_are_closer_than_one_and_calibrated(folder: Path, known: Choice) -> None:
    write_sequences(folder / "two.parquet", 30, 12, cameras=2, seed=6)
    both = read_sequences(folder / "two.parquet")
    one, two = (track_scores(both[:k], known, resamples=50) for k in (1, 2))
    assert (one.name, two.name) == ("12 frames", "12 frames, 2 cameras")
    for method in METHODS:
        assert value(two, "depth_error_mm", method) < 0.7 * value(one, "depth_error_mm", method)
    for method in ("single", "independent"):
        assert value(two, "nees", method) == pytest.approx(1, abs=0.25)
    seen_again = both[1].pose.into_world(both[1].xyz)
    torch.testing.assert_close(both[0].pose.into_world(both[0].xyz), seen_again)


@pytest.mark.parametrize("cameras", [1, 2])
def test_held_out_sequences_choose_noise_and_slow_errors(folder: Path, cameras: int) -> None:
    write_sequences(folder / "held.parquet", 40 // cameras, FRAMES, cameras=cameras, errors=ERRORS, seed=2)
    every = read_sequences(folder / "held.parquet")
    choice = choose([every])
    assert choice.correlated == correlated([every])
    assert (choice.correlated == correlated([every[:1]])) == (cameras == 1)
    assert choice.speed == pytest.approx(MOTION.speed, rel=0.3)
    for name in ("depth_time", "projection_time"):
        for found in (choice.correlated, choice.slow):  # of 40 short sequences
            assert getattr(SLOW, name) / 8 < getattr(found, name) < 4 * getattr(SLOW, name)
    for method in SMOOTHERS:
        assert 0.05 < choice.noise[method] < 1.5, "0.3 made them"
    if cameras > 1:
        assert value(track_scores(every, choice, resamples=2), "nees", "slow") == pytest.approx(1.1, abs=0.15)


def test_independent_errors_choose_no_slow_ones(folder: Path) -> None:
    write_sequences(folder / "none.parquet", 20, FRAMES, seed=3)
    choice = choose([read_sequences(folder / "none.parquet")])
    assert choice.slow.depth_time < 0.03  # seconds: less than a frame
    assert choice.slow.projection_time < 0.03


def test_a_sequence_with_a_value_that_is_not_finite_is_left_out(independent: SeveralViews, folder: Path) -> None:
    table = pd.read_parquet(folder / "independent.parquet")
    table.loc[FRAMES + 3, "mu_z"] = np.nan
    table.to_parquet(folder / "broken.parquet")
    (broken,) = read_sequences(folder / "broken.parquet")
    assert (broken.n, broken.left_out) == (N - 1, 1)
    assert torch.equal(broken.xyz[1], independent.xyz[2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="time"), "no column time"),
        (lambda t: t.iloc[:-1], "not sequences of equal length"),
        (lambda t: t.assign(track=0), "sequences of equal length|increase"),
        (lambda t: t.assign(time=1.0), "do not increase"),
        (lambda t: t.assign(a=-1.0), "no predictions with poses"),
        (lambda t: t.assign(mu_z=np.inf), "of no scene all predictions are finite"),
    ],
)
def test_a_bad_record_is_one_line(independent: SeveralViews, folder: Path, change, message: str) -> None:
    change(pd.read_parquet(folder / "independent.parquet")).to_parquet(folder / "bad.parquet")
    with pytest.raises(RunError, match=message) as error:
        read_sequences(folder / "bad.parquet")
    assert "\n" not in str(error.value)
