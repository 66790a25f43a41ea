"""Mean errors against a hand computation, and files that are not what they should be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from phd_exp.evaluation.point_errors import (
    READINGS,
    ErrorKey,
    errors_mm,
    in_central_half,
    mean_errors,
    mean_nll,
)
from phd_exp.metrics.errors import depth_error, projected_error
from phd_exp.records.errors import RunError
from tests.reports.recorded import Predicted, by_hand, predicted

ALL = ("mode", "mean", "median")


@pytest.fixture
def drawn() -> Predicted:
    return predicted(seed=0, n=200)


@pytest.fixture
def file(drawn: Predicted, tmp_path: Path) -> Path:
    drawn.frame.to_parquet(tmp_path / "predictions.parquet")
    return tmp_path / "predictions.parquet"


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("estimate", ALL)
@pytest.mark.parametrize("quantity", ["projected", "depth"])
def test_means_are_those_computed_by_hand(
    drawn: Predicted, file: Path, reading: str, estimate: str, quantity: str
) -> None:
    counted = np.ones(200, bool) if reading == "whole" else (np.abs(drawn.v_p) <= 0.5).all(axis=1)
    values = by_hand(drawn, estimate, quantity)[counted]
    mean = mean_errors(file, ALL)[ErrorKey(estimate, reading, quantity)]
    assert mean.n == counted.sum()
    assert mean.value == pytest.approx(values.mean(), rel=1e-9)
    assert mean.standard_error == pytest.approx(pd.Series(values).sem(), rel=1e-9)


def test_some_and_not_all_are_central(drawn: Predicted) -> None:
    inside = (np.abs(drawn.v_p) <= 0.5).all(axis=1).sum()
    assert 20 < inside < 90  # a quarter of the area


def test_errors_are_those_that_training_records(drawn: Predicted) -> None:
    truth, mode = torch.from_numpy(drawn.truth), torch.from_numpy(drawn.estimates["mode"])
    ours = errors_mm(drawn.truth, drawn.estimates["mode"])
    np.testing.assert_allclose(ours["projected"], 1000 * projected_error(truth, mode), rtol=1e-9)
    np.testing.assert_allclose(ours["depth"], 1000 * depth_error(truth, mode), rtol=1e-9)


def test_an_image_that_is_shrunk_has_the_same_central_half(drawn: Predicted) -> None:
    f = drawn.frame["f"].to_numpy()
    expected = in_central_half(drawn.truth, f, np.full(200, 224.0))
    np.testing.assert_array_equal(in_central_half(drawn.truth, f / 2, np.full(200, 112.0)), expected)


def test_the_edge_of_the_central_half_belongs_to_it() -> None:
    truth = np.array([[0.5, -0.5, 4.0], [0.5000001, 0.0, 4.0], [0.0, -0.5000001, 4.0]])
    f, S = np.full(3, 8.0), np.full(3, 4.0)  # v_p = x, exactly
    assert in_central_half(truth, f, S).tolist() == [True, False, False]


def test_a_reading_without_samples_has_no_mean(tmp_path: Path) -> None:
    drawn = predicted(seed=1)
    outside = drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)]
    outside.to_parquet(tmp_path / "p.parquet")
    assert {key.reading for key in mean_errors(tmp_path / "p.parquet", ["mode"])} == {"whole"}


def test_one_sample_has_no_standard_error(tmp_path: Path) -> None:
    predicted(seed=2, n=1).frame.to_parquet(tmp_path / "p.parquet")
    means = mean_errors(tmp_path / "p.parquet", ["mode"])
    assert {(mean.n, mean.standard_error) for mean in means.values()} == {(1, None)}


def test_nll_where_there_is_one(drawn: Predicted, file: Path, tmp_path: Path) -> None:
    assert mean_nll(file) == pytest.approx(drawn.frame["nll"].mean())
    predicted(seed=0, probabilistic=False).frame.to_parquet(tmp_path / "point.parquet")
    assert mean_nll(tmp_path / "point.parquet") is None


BAD: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str]] = {
    "no column": (lambda frame: frame.drop(columns=["mode_y", "f"]), "has no column f, mode_y"),
    "no median": (lambda frame: frame.drop(columns="median_z"), "has no column median_z"),
    "no rows": (lambda frame: frame.iloc[:0], "has no rows"),
    "nan": (
        lambda frame: frame.assign(mode_x=frame["mode_x"].where(frame.index != 7)),
        "mode_x is nan in row 7",
    ),
    "infinite": (lambda frame: frame.assign(mean_z=np.inf), "mean_z is inf in row 0"),
    "no depth": (lambda frame: frame.assign(z=0.0), "z is 0 in row 0; expected more than 0"),
    "no sensor": (lambda frame: frame.assign(S=-frame["S"]), "S is -224 in row 0"),
    "far off": (lambda frame: frame.assign(mean_x=1e200), "mean_x is 1e+200 in row 0"),
    "a median far off": (lambda frame: frame.assign(mu_x=1e99, median_z=1e99), "no finite number"),
    "words": (lambda frame: frame.assign(mu_x="far left"), "column 'mu_x' holds"),
    "lists": (lambda frame: frame.assign(mu_y=[[1.0]] * len(frame)), "column 'mu_y' holds"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_one_line(drawn: Predicted, tmp_path: Path, name: str) -> None:
    spoil, said = BAD[name]
    spoil(drawn.frame).to_parquet(tmp_path / "predictions.parquet")
    with pytest.raises(RunError) as caught:
        mean_errors(tmp_path / "predictions.parquet", ALL)
    assert str(caught.value).startswith("predictions.parquet: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no parquet", None], ids=["empty", "garbage", "torn"])
def test_a_file_that_is_no_parquet_is_one_line(file: Path, content: bytes | None) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(RunError, match=r"^predictions.parquet: cannot be read \(.*\)$"):
        mean_errors(file, ALL)


def test_pages_that_rot_on_the_disk_are_one_line(file: Path) -> None:
    whole = bytearray(file.read_bytes())
    whole[4:400] = bytes(396)
    file.write_bytes(whole)
    with pytest.raises(RunError, match=r"^predictions.parquet: "):
        mean_errors(file, ALL)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"predictions.parquet: missing"):
        mean_errors(tmp_path / "predictions.parquet", ALL)
