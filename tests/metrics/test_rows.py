"""One table from batches and processes of any size and order."""

from collections.abc import Sequence

import pytest
import torch

from phd_exp.metrics.rows import Rows

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
