"""Mean errors against a hand computation, and files that are not what they should be."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from phd_exp.evaluation.parquet import read_table
from phd_exp.evaluation.point_errors import READINGS, ErrorKey, MeanErrors, in_central_half, mean_errors
from phd_exp.records.errors import RunError
from tests.reports.recorded import Predicted, by_hand, predicted

ALL = ("mode", "mean", "median")


@pytest.fixture
def drawn() -> Predicted:
    return predicted(seed=0, n=200)


def means(frame: pd.DataFrame, estimates: tuple[str, ...] = ALL) -> MeanErrors:
    return mean_errors({name: frame[name].to_numpy(float) for name in frame}, estimates)


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("estimate", ALL)
@pytest.mark.parametrize("quantity", ["projected", "depth"])
def test_means_are_those_computed_by_hand(
    drawn: Predicted, reading: str, estimate: str, quantity: str
) -> None:
    counted = np.ones(200, bool) if reading == "whole" else (np.abs(drawn.v_p) <= 0.5).all(axis=1)
    values = by_hand(drawn, estimate, quantity)[counted]
    mean = means(drawn.frame)[ErrorKey(estimate, reading, quantity)]
    assert mean.n == counted.sum()
    assert mean.value == pytest.approx(values.mean(), rel=1e-9)
    assert mean.standard_error == pytest.approx(pd.Series(values).sem(), rel=1e-9)


def test_some_and_not_all_are_central(drawn: Predicted) -> None:
    inside = (np.abs(drawn.v_p) <= 0.5).all(axis=1).sum()
    assert 20 < inside < 90  # a quarter of the area


def test_an_image_that_is_shrunk_has_the_same_central_half(drawn: Predicted) -> None:
    truth, f = torch.tensor(drawn.truth), torch.tensor(drawn.frame[["f"]].to_numpy())
    expected = in_central_half(truth, f, torch.full_like(f, 224))
    assert torch.equal(in_central_half(truth, f / 2, torch.full_like(f, 112)), expected)
    assert expected.numpy().tolist() == (np.abs(drawn.v_p) <= 0.5).all(axis=1).tolist()


def test_the_edge_of_the_central_half_belongs_to_it() -> None:
    truth = torch.tensor(
        [[0.5, -0.5, 4.0], [0.5000001, 0.0, 4.0], [0.0, -0.5000001, 4.0]], dtype=torch.float64
    )
    f, S = torch.full((3, 1), 8.0).double(), torch.full((3, 1), 4.0).double()  # v_p = x, exactly
    assert in_central_half(truth, f, S).tolist() == [True, False, False]


def test_a_reading_without_samples_has_no_mean() -> None:
    drawn = predicted(seed=1)
    outside = drawn.frame[(np.abs(drawn.v_p) > 0.5).any(axis=1)]
    assert {key.reading for key in means(outside, ("mode",))} == {"whole"}


def test_one_sample_has_no_standard_error() -> None:
    found = means(predicted(seed=2, n=1).frame, ("mode",))
    assert {(mean.n, mean.standard_error) for mean in found.values()} == {(1, None)}


def test_runs_on_the_same_images_are_resampled_alike(drawn: Predicted) -> None:
    """So that the resamples of two runs can be subtracted: those of equal errors cancel."""
    frame = drawn.frame
    worse = frame.assign(mode_z=frame["mode_z"] + 0.001)
    key = ErrorKey("mode", "whole", "depth")
    first, same, other = (means(table, ("mode",))[key].resampled for table in (frame, frame, worse))
    np.testing.assert_array_equal(first, same)
    assert np.std(other - first) < np.std(first)
    assert np.std(first) == pytest.approx(means(frame, ("mode",))[key].standard_error, rel=0.3)


BAD: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str]] = {
    "no column": (lambda frame: frame.drop(columns=["mode_y", "f"]), "have no column f, mode_y"),
    "no median": (lambda frame: frame.drop(columns="median_z"), "have no column median_z"),
    "nan": (
        lambda frame: frame.assign(mode_x=frame["mode_x"].where(frame.index != 7)),
        "column mode_x is not finite",
    ),
    "no depth": (lambda frame: frame.assign(z=0.0), "column z is not finite everywhere, or not positive"),
    "far off": (lambda frame: frame.assign(mean_x=1e300), "mean error is not finite"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content_is_one_line(drawn: Predicted, name: str) -> None:
    spoil, said = BAD[name]
    with pytest.raises(RunError, match=said) as caught:
        means(spoil(drawn.frame))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"no parquet", None], ids=["empty", "garbage", "torn"])
def test_a_file_that_is_no_parquet_is_one_line(
    drawn: Predicted, tmp_path: Path, content: bytes | None
) -> None:
    file = tmp_path / "predictions.parquet"
    drawn.frame.to_parquet(file)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(RunError, match=r"^predictions.parquet: cannot be read \(.*\)$"):
        read_table(file)


def test_pages_that_rot_on_the_disk_are_one_line(drawn: Predicted, tmp_path: Path) -> None:
    file = tmp_path / "predictions.parquet"
    drawn.frame.to_parquet(file)
    whole = bytearray(file.read_bytes())
    whole[4:400] = bytes(396)
    file.write_bytes(whole)
    with pytest.raises(RunError, match=r"^predictions.parquet: "):
        read_table(file)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"predictions.parquet: missing"):
        read_table(tmp_path / "predictions.parquet")
