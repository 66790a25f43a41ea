"""Bootstrap intervals have the width and the coverage of theory."""

from collections.abc import Mapping

import pytest
import torch

from phd_exp.metrics.bootstrap import bands, resampled


def means(columns: Mapping[str, torch.Tensor], weight: torch.Tensor) -> dict[str, torch.Tensor]:
    scalar = (weight * columns["x"]).sum(-1) / weight.sum(-1)
    return {"mean": scalar, "curve": scalar[:, None] * torch.tensor([1.0, 2.0, 3.0])}


def numbers(n: int, seed: int) -> torch.Tensor:
    return 2 * torch.randn(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_resample_draws_as_many_with_replacement() -> None:
    _, drawn = resampled(lambda columns, counts: {"counts": counts}, {"x": torch.zeros(50)}, 4000, seed=0)
    counts = drawn["counts"]
    assert (counts.sum(-1) == 50).all()
    assert counts.mean(0).sub(1).abs().max() < 0.08
    assert (counts == 0).double().mean().item() == pytest.approx((1 - 1 / 50) ** 50, abs=0.01)


def test_interval_of_a_mean_has_the_width_of_theory() -> None:
    x = numbers(2000, seed=1)
    band = bands(means, {"x": x}, resamples=2000, seed=0)["mean"]
    assert band.value.item() == pytest.approx(x.mean().item())
    assert (band.high - band.low).item() == pytest.approx(2 * 1.96 * x.std().item() / 2000**0.5, rel=0.06)
    curve = bands(means, {"x": x}, resamples=2000, seed=0)["curve"]
    torch.testing.assert_close(curve.high, band.high * torch.tensor([1.0, 2.0, 3.0]).double())


def test_intervals_contain_the_truth_as_often_as_they_claim() -> None:
    held = [
        band.low <= 0 <= band.high
        for seed in range(300)
        for band in [bands(means, {"x": numbers(200, seed)}, resamples=200, seed=seed)["mean"]]
    ]
    assert sum(held) / 300 == pytest.approx(0.95, abs=0.035)


def test_resamples_continue_one_stream_of_their_seed() -> None:
    """300,000 samples do not fit into one part with 5 resamples; the first resamples do not depend on later ones."""
    columns = {"x": numbers(300_000, seed=1)}
    few, more = (resampled(means, columns, n, seed=0)[1]["mean"] for n in (2, 5))
    torch.testing.assert_close(more[:2], few)
    assert len(set(more.tolist())) == 5
    one, same, other = (bands(means, {"x": numbers(100, seed=1)}, 50, seed)["mean"] for seed in (0, 0, 1))
    assert (one.low, one.high) == (same.low, same.high)
    assert one.low != other.low


def test_an_interval_contains_its_value_where_resampling_adds_noise() -> None:
    """The distance of a mean from a number that it equals: every resample is further away."""
    x = torch.tensor([-1.0, 1.0] * 50, dtype=torch.float64)
    x[0] += 1e-9

    def distance(columns: Mapping[str, torch.Tensor], weight: torch.Tensor) -> dict[str, torch.Tensor]:
        mean = means(columns, weight)["mean"].abs()
        return {"distance": mean.clamp_min(1e-3) * (1 + (weight != 1).any(-1))}

    band = bands(distance, {"x": x}, resamples=100, seed=0)["distance"]
    assert band.low == band.value < band.high


@pytest.mark.parametrize(("n", "resamples"), [(0, 10), (1, 10), (5, 0)])
def test_bad_arguments_are_refused(n: int, resamples: int) -> None:
    with pytest.raises(ValueError, match="a bootstrap needs"):
        bands(means, {"x": torch.ones(n)}, resamples, 0)
