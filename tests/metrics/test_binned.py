"""The metric of fixed size against the scores of the samples themselves, however they are dealt out."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch
from torch import distributed, multiprocessing

from phd_exp.metrics.binned import BINS, Calibration
from phd_exp.metrics.calibration_scores import COLUMNS, exact_scores

CASES: dict[str, dict[str, float]] = {
    "perfect": {},
    "overconfident": {"overconfidence": 2.0},
    "cautious": {"overconfidence": 0.5},
    "shifted": {"shift": 1.0},
}
MEANS = ("depth_crps_mm", "depth_sharpness_mm", "projected_sharpness_mrad", "left_out")


def batches(columns: Mapping[str, torch.Tensor], size: int) -> list[dict[str, torch.Tensor]]:
    parts = zip(*(columns[name].split(size) for name in COLUMNS), strict=True)
    return [dict(zip(COLUMNS, part, strict=True)) for part in parts]


def seen(parts: list[dict[str, torch.Tensor]]) -> Calibration:
    metric = Calibration()
    for part in parts:
        metric.update(part)
    return metric


def merged(metrics: list[Calibration]) -> Calibration:
    """As torchmetrics does between processes."""
    whole = Calibration()
    for name, reduce in whole._reductions.items():
        assert callable(reduce)
        setattr(whole, name, reduce(torch.stack([getattr(metric, name) for metric in metrics])))
    whole._update_count = 1
    return whole


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("n", [60, 2000])
def test_agrees_with_the_exact_scores(claimed: Callable, case: str, n: int) -> None:
    columns = claimed(n, **CASES[case])
    exact, binned = exact_scores(columns), seen(batches(columns, 64)).compute()
    assert binned.keys() == exact.keys()
    for name, value in exact.items():
        if name in MEANS:
            assert binned[name].item() == pytest.approx(value, rel=1e-9), name
        elif "risk" in name or "ence" in name:  # neighbours in variance may change places
            assert binned[name].item() == pytest.approx(value, rel=0.02, abs=0.003), name
        else:
            assert binned[name].item() == pytest.approx(value, abs=1 / BINS), name


@pytest.mark.parametrize("processes", [2, 3])
def test_any_split_over_processes_gives_the_same(claimed: Callable, processes: int) -> None:
    columns = claimed(1000)
    whole = seen(batches(columns, 64)).compute()
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    shuffled = batches({name: columns[name][order] for name in COLUMNS}, 37)
    split = merged([seen(shuffled[rank::processes]) for rank in range(processes)]).compute()
    for name, value in whole.items():
        assert split[name].item() == pytest.approx(value.item(), rel=1e-9, abs=1e-12), name


def test_state_has_one_size(claimed: Callable) -> None:
    sizes = set()
    for n in (1, 100, 5000):
        metric = seen(batches(claimed(n), 64))
        sizes.add(sum(getattr(metric, name).numel() for name in metric._defaults))
    (size,) = sizes
    assert 8 * size < 800_000  # bytes


def test_left_out_is_counted_and_changes_nothing_else(claimed: Callable) -> None:
    columns = claimed(200)
    broken = {name: torch.cat([columns[name], torch.tensor([math.inf, 1.0])]) for name in COLUMNS}
    broken["level"][-1] = math.nan
    scores, expected = seen([broken]).compute(), seen([dict(columns)]).compute()
    assert scores["left_out"] == 2
    for name, value in expected.items():
        if name != "left_out":
            assert scores[name].item() == pytest.approx(value.item(), rel=1e-12), name


def test_extremes_fall_into_the_bins_at_the_ends() -> None:
    columns = {name: torch.tensor([0.0, 1e-30, 1e30], dtype=torch.float64) for name in COLUMNS}
    columns["level"] = columns["depth_pit"] = torch.tensor([0.0, 1.0, 1.0])
    metric = seen([columns])
    assert (metric.sums[..., 0].sum(-1) == 3).all()
    assert metric.compute()["depth_sharpness_mm"].item() == pytest.approx(1000 * (1e30 / 3) ** 0.5)


def test_nothing_seen_is_nan() -> None:
    metric = seen([{name: torch.full((3,), math.nan) for name in COLUMNS}])
    scores = metric.compute()
    assert scores.pop("left_out") == 3
    assert all(score.isnan() for score in scores.values())
    metric.reset()
    assert metric.left_out == 0


def test_every_column_must_be_given(claimed: Callable) -> None:
    columns = dict(claimed(10))
    del columns["level"]
    with pytest.raises(KeyError, match="level"):
        Calibration().update(columns)


def _process(rank: int, file: Path, columns: dict[str, torch.Tensor]) -> None:
    distributed.init_process_group("gloo", f"file://{file}", rank=rank, world_size=2)
    torch.set_num_threads(1)
    scores = seen(batches(columns, 50)[rank::2]).compute()
    if rank == 0:
        torch.save(scores, file.with_suffix(".pt"))
    distributed.destroy_process_group()


@pytest.mark.slow
def test_two_processes_by_gloo(claimed: Callable, tmp_path: Path) -> None:
    columns = {name: claimed(700)[name] for name in COLUMNS}
    multiprocessing.spawn(_process, (tmp_path / "meeting", columns), nprocs=2)
    scores = torch.load(tmp_path / "meeting.pt")
    for name, value in seen(batches(columns, 50)).compute().items():
        assert scores[name].item() == pytest.approx(value.item(), rel=1e-9, abs=1e-12), name
