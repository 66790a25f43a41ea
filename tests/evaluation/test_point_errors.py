"""Mean errors against a hand computation, and tables with bad content."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.point_errors import READINGS, ErrorKey, MeanErrors, in_central_half, mean_errors, significant
from phd_exp.records.errors import RunError
from tests.support.recorded import Predicted, by_hand, predicted

ALL = ("mode", "mean", "median")


@pytest.fixture
def drawn() -> Predicted:
    return predicted(seed=0, n=200)


def means(frame: pd.DataFrame, estimates: tuple[str, ...] = ALL) -> MeanErrors:
    return mean_errors({name: frame[name].to_numpy(float) for name in frame}, estimates)


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("estimate", ALL)
@pytest.mark.parametrize("quantity", ["projected", "depth"])
def test_means_equal_a_hand_computation(drawn: Predicted, reading: str, estimate: str, quantity: str) -> None:
    counted = np.ones(200, bool) if reading == "whole" else (np.abs(drawn.v_p) <= 0.5).all(axis=1)
    values = by_hand(drawn, estimate, quantity)[counted]
    mean = means(drawn.frame)[ErrorKey(estimate, reading, quantity)]
    assert mean.n == counted.sum()
    assert mean.value == pytest.approx(values.mean(), rel=1e-9)
    assert mean.standard_error == pytest.approx(pd.Series(values).sem(), rel=1e-9)


def test_a_smaller_copy_of_an_image_has_the_same_central_half(drawn: Predicted) -> None:
    truth, f = torch.tensor(drawn.truth), torch.tensor(drawn.frame[["f"]].to_numpy())
    expected = (np.abs(drawn.v_p) <= 0.5).all(axis=1)
    assert 20 < expected.sum() < 90  # a quarter of the area
    for scale in (1.0, 0.5):
        found = in_central_half(truth, scale * f, torch.full_like(f, scale * 224))
        assert found.numpy().tolist() == expected.tolist()
    # the edge is inside
    truth = torch.tensor([[0.5, -0.5, 4.0], [0.5000001, 0.0, 4.0], [0.0, -0.5000001, 4.0]], dtype=torch.float64)
    f, S = torch.full((3, 1), 8.0).double(), torch.full((3, 1), 4.0).double()  # v_p = x, exactly
    assert in_central_half(truth, f, S).tolist() == [True, False, False]


def test_few_samples_have_no_mean_or_no_standard_error() -> None:
    drawn = predicted(seed=1)
    outside = drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)]
    assert {key.reading for key in means(outside, ("mode",))} == {"whole"}
    found = means(predicted(seed=2, n=1).frame, ("mode",))
    assert {(mean.n, mean.standard_error) for mean in found.values()} == {(1, None)}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda frame: frame.drop(columns=["mode_y", "f"]), "no column f, mode_y"),
        (lambda frame: frame.drop(columns="median_z"), "no column median_z"),
        (lambda frame: frame.assign(mode_x=frame["mode_x"].where(frame.index != 7)), "mode_x is not finite"),
        (lambda frame: frame.assign(z=0.0), "column z is not finite everywhere, or not positive"),
        (lambda frame: frame.assign(mean_x=1e300), "mean error is not finite"),
    ],
)
def test_bad_content_is_one_line(
    drawn: Predicted, spoil: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    with pytest.raises(RunError, match=message) as caught:
        means(spoil(drawn.frame))
    assert "\n" not in str(caught.value)


SPOILED: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda whole: b"",
    "no parquet": lambda whole: b"no parquet",
    "torn": lambda whole: whole[: len(whole) // 2],
    "rotten pages": lambda whole: whole[:4] + bytes(396) + whole[400:],
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_file_that_cannot_be_read_is_one_line(drawn: Predicted, tmp_path: Path, name: str) -> None:
    file = tmp_path / "predictions.parquet"
    with pytest.raises(RunError, match=r"^/.*/predictions\.parquet: missing"):
        read_table(file)
    drawn.frame.to_parquet(file)
    file.write_bytes(SPOILED[name](file.read_bytes()))
    with pytest.raises(RunError, match=r"^/.*/predictions\.parquet: cannot be read \([^;]*\)$"):
        read_table(file)


def test_rows_are_bounded_before_they_are_read(tmp_path: Path) -> None:
    """900,000 equal rows take 121 kB on disk."""
    names = [f"c{index}" for index in range(30)]
    table = pa.table({name: pa.array(np.zeros(900_000)) for name in names})
    pq.write_table(table, tmp_path / "predictions.parquet", compression="zstd")
    assert (tmp_path / "predictions.parquet").stat().st_size < 200_000
    with pytest.raises(RunError, match=r"has 900000 rows of 30 columns.*expected at most"):
        read_table(tmp_path / "predictions.parquet")


@pytest.mark.parametrize("value", [float("nan"), 1.5, -0.1])
def test_no_hypothesis_is_rejected_by_what_is_no_probability(value: float) -> None:
    with pytest.raises(ValueError, match="expected probabilities"):
        significant({"a": value, "b": 0.5})
