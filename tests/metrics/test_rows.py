"""One table from batches and processes of any size and order; every sample is in exactly one stratum."""

import math
from collections.abc import Sequence

import pytest
import torch

from phd_exp.metrics.rows import Rows
from phd_exp.metrics.strata import strata

N = 23


def table(rows: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"row": rows, "error": rows.float() / 7}


def collected(parts: Sequence[torch.Tensor]) -> Rows:
    found = Rows()
    for part in parts:
        found.update(table(part))
    return found


@pytest.mark.parametrize("sizes", [[N], [1, N - 1], [8, 8, 7]])
def test_batches_do_not_matter(sizes: list[int]) -> None:
    shuffled = torch.randperm(N, generator=torch.Generator().manual_seed(0))
    found = collected(shuffled.split(sizes)).columns()
    assert found["row"].tolist() == list(range(N))
    torch.testing.assert_close(found["error"], torch.arange(N).float().double() / 7, rtol=1e-6, atol=0)
    assert {column.dtype for column in found.values()} == {torch.float64}
    one = collected([torch.tensor([0])]).columns()
    assert {name: column.shape for name, column in one.items()} == {"row": (1,), "error": (1,)}


def test_processes_do_not_matter() -> None:
    """Each takes every second row; merged as torchmetrics merges their states."""
    ranks = [collected(torch.arange(N)[rank::2].split(4)) for rank in range(2)]
    ranks[0].merge_state(ranks[1])
    whole = collected([torch.arange(N)]).columns()
    for name, column in ranks[0].columns().items():
        assert torch.equal(column, whole[name]), name


def test_a_checkpoint_in_the_middle_of_an_epoch_holds_the_rows_so_far() -> None:
    first, second = torch.arange(N).split([9, N - 9])
    resumed = Rows()
    resumed.load_state_dict(collected([first]).state_dict())
    resumed.update(table(second))
    assert torch.equal(resumed.columns()["error"], collected([first, second]).columns()["error"])


def test_other_columns_are_refused() -> None:
    found = collected([torch.arange(3)])
    with pytest.raises(ValueError, match="expected columns"):
        found.update({"row": torch.arange(3)})


VALUES = {
    "spread": torch.rand(500, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
    "with NaN": torch.tensor([0.1, math.nan, 0.7, 0.3, math.nan]),
    "many equal": torch.tensor([1.0] * 90 + [0.2, 0.5, 0.7] * 3),
    "all equal": torch.full((7,), 0.5),
    "all NaN": torch.full((3,), math.nan),
    "on the edges": torch.tensor([0.0, 0.25, 0.5, 1.0]),
    "beyond the edges": torch.tensor([-1.0, 0.3, 2.0]),
    "none": torch.zeros(0),
}


@pytest.mark.parametrize("edges", [1, 4, (0.0, 0.25, 0.5, 1.0), (0.5,)], ids=str)
@pytest.mark.parametrize("name", VALUES)
def test_every_sample_is_in_exactly_one(name: str, edges: int | tuple[float, ...]) -> None:
    found = strata("x", VALUES[name], edges)
    masks = torch.stack([torch.zeros(len(VALUES[name]), dtype=torch.bool), *found.values()])
    assert (masks.sum(0) == 1).all()
    assert all(mask.any() for mask in found.values())


def test_labels_say_name_edges_and_unit() -> None:
    depth, visibility = torch.linspace(3, 5, 401), torch.tensor([0.1, 0.25, 0.5, 1.0, math.nan])
    parts = ("3.0-3.5", "3.5-4.0", "4.0-4.5", "4.5-5.0")
    assert list(strata("depth", depth, 4, "m")) == [f"depth {part} m" for part in parts]
    parts = ("0-0.25", "0.25-0.5", "0.5-0.9", "above 0.9", "unknown")
    assert list(strata("visibility", visibility, (0.0, 0.25, 0.5, 0.9))) == [f"visibility {part}" for part in parts]
    assert [int(mask.sum()) for mask in strata("x", VALUES["spread"], 4).values()] == [125, 125, 125, 125]
    masks = [mask.int().tolist() for mask in strata("x", VALUES["on the edges"], (0.0, 0.25, 0.5, 1.0)).values()]
    assert masks == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]]
