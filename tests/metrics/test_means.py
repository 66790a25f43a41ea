"""Means over samples, not over batches."""

import pytest
import torch

from phd_exp.metrics.means import Means


def test_batches_of_any_size_give_the_mean_over_samples() -> None:
    values = {"depth": torch.arange(10.0), "loss": torch.arange(10.0).square()}
    means = Means(["loss", "depth"])
    for rows in (slice(0, 1), slice(1, 7), slice(7, 10)):
        means.update({name: column[rows] for name, column in values.items()})
    assert means.compute() == {"loss": pytest.approx(28.5), "depth": pytest.approx(4.5)}


def test_small_numbers_are_not_lost_beside_large_ones() -> None:
    means = Means(["error"])
    means.update({"error": torch.tensor([1e8])})
    for _ in range(1000):
        means.update({"error": torch.tensor([1.0])})
    assert means.compute()["error"].item() == pytest.approx((1e8 + 1000) / 1001, rel=1e-12)


def test_two_processes_add_up() -> None:
    parts = [Means(["error"]) for _ in range(2)]
    for part, value in zip(parts, (1.0, 4.0), strict=True):
        part.update({"error": torch.full((3,), value)})
    merged = Means(["error"])
    for name, reduce in merged._reductions.items():
        assert reduce is not None
        setattr(merged, name, sum(getattr(part, name) for part in parts))
    assert (merged.sums / merged.count).tolist() == [2.5]


def test_every_name_must_be_given() -> None:
    with pytest.raises(KeyError):
        Means(["error"]).update({"other": torch.zeros(2)})
