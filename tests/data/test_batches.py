"""The order of batches: a function of (seed, epoch), resumable at any batch."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from phd_exp.data.batches import Batch, BatchLoader

N = 10


@pytest.fixture
def samples() -> Batch:
    return Batch(
        image=torch.arange(N, dtype=torch.uint8).view(N, 1, 1, 1).expand(N, 4, 4, 3),
        xyz=torch.arange(3.0 * N).view(N, 3),
        f=torch.arange(1.0, N + 1),
        S=4.0,
        row=torch.arange(N),
    )


def loader(samples: Batch, shuffle: bool = True, size: int = 3, **others: Any) -> BatchLoader:
    return BatchLoader(samples, size, shuffle, **{"seed": 0} | others)


def rows(batches: list[Batch]) -> list[int]:
    return torch.cat([batch.row for batch in batches]).tolist()


def test_every_sample_once_an_epoch_and_in_another_order_the_next(samples: Batch) -> None:
    batches = loader(samples, size=5)
    first, second = rows(list(batches)), rows(list(batches))
    assert sorted(first) == sorted(second) == list(range(N))
    assert first != second
    assert rows(list(loader(samples, shuffle=False))) == list(range(N)), "the order of the data set"


def test_order_depends_on_seed_and_epoch_alone(samples: Batch) -> None:
    one, other = loader(samples, size=5), loader(samples, size=5)
    next(iter(one))  # an interrupted epoch
    other.epoch = 0
    assert rows(list(other)) == one.order(1).tolist()
    assert loader(samples, seed=1).order(0).tolist() != one.order(0).tolist()


def test_rows_stay_together(samples: Batch) -> None:
    for batch in loader(samples):
        assert batch.image[:, 0, 0, 0].tolist() == batch.row.tolist()
        assert batch.f.tolist() == (batch.row + 1.0).tolist()
        assert torch.equal(batch.xyz, samples.xyz[batch.row])
        assert batch.S == 4.0


@pytest.mark.parametrize(("shuffle", "sizes"), [(False, [3, 3, 3, 1]), (True, [3, 3, 3])])
def test_length(samples: Batch, shuffle: bool, sizes: list[int]) -> None:
    batches = loader(samples, shuffle)
    assert [len(batch) for batch in batches] == sizes
    assert len(batches) == len(sizes)


@pytest.mark.parametrize("done", [0, 1, 2, 3])
def test_resumes_with_the_remaining_batches(samples: Batch, done: int) -> None:
    whole = loader(samples)
    expected = [rows([batch]) for _ in range(3) for batch in whole]

    broken = loader(samples)
    list(broken)  # epoch 0
    epoch = iter(broken)
    found = [rows([next(epoch)]) for _ in range(done)]
    resumed = loader(samples)
    resumed.load_state_dict(broken.state_dict())
    found += [rows([batch]) for batch in resumed] if done < 3 else []
    found += [rows([batch]) for batch in resumed]
    assert found == expected[3:]


def test_samples_are_copied_to_another_device_batch_by_batch(samples: Batch) -> None:
    for batch in loader(samples, device=torch.device("meta")):
        assert (batch.image.device.type, batch.image.shape) == ("meta", (3, 4, 4, 3))


@pytest.mark.parametrize("world", [1, 2, 3])
@pytest.mark.parametrize("shuffle", [False, True])
def test_shares_are_each_batch_without_gaps_and_repeats(samples: Batch, world: int, shuffle: bool) -> None:
    whole = loader(samples, shuffle, seed=5)
    shares = [loader(samples, shuffle, seed=5, rank=rank, world=world) for rank in range(world)]
    for _ in range(2):  # epochs
        batches, of_ranks = list(whole), [list(share) for share in shares]
        assert [len(parts) for parts in of_ranks] == [len(share) for share in shares]
        for place, batch in enumerate(batches):
            parts = [rows([share[place]]) for share in of_ranks if place < len(share)]
            assert sorted(row for part in parts for row in part) == sorted(rows([batch]))
            assert parts[0] == rows([batch])[::world]
    assert len({tuple(share.state_dict().items()) for share in shares if shuffle}) <= 1


class Shift:
    """Adds one of the numbers to the positions."""

    n_numbers = 3

    def __call__(self, batch: Batch, numbers: torch.Tensor) -> Batch:
        return replace(batch, xyz=batch.xyz + numbers[:, :1])


def test_random_changes_depend_on_seed_epoch_and_batch_alone(samples: Batch) -> None:
    def changing(seed: int = 0, **share: int) -> BatchLoader:
        return loader(samples, size=4, seed=seed, augment=Shift(), **share)

    first, again = list(changing()), list(changing())
    assert all(torch.equal(one.xyz, other.xyz) for one, other in zip(first, again, strict=True))
    for batch in first:
        shift = batch.xyz - samples.xyz[batch.row]
        assert shift.abs().max() <= 1
        assert len(shift[:, 0].unique()) == len(batch)
    resumed = changing()
    resumed.load_state_dict({"epoch": 0, "next_batch": 1})
    assert torch.equal(next(iter(resumed)).xyz, first[1].xyz)
    later = changing()
    later.load_state_dict({"epoch": 3, "next_batch": 0})
    order = later.order(4).tolist()
    shifts = next(iter(later)).xyz[:, 0] - samples.xyz[order[:4], 0]
    assert not torch.equal(shifts, first[0].xyz[:, 0] - samples.xyz[first[0].row, 0])
    # of two processes that share each batch, one has the even and one the odd rows of it
    for rank in range(2):
        for mine, whole in zip(changing(rank=rank, world=2), first, strict=True):
            assert torch.equal(mine.xyz, whole.xyz[rank::2])


def test_every_row_gets_all_eight_signs_in_eight_epochs(samples: Batch) -> None:
    class Signs:
        """Records the signs of the first three numbers as positions."""

        n_numbers = 3

        def __call__(self, batch: Batch, numbers: torch.Tensor) -> Batch:
            assert numbers.abs().max() <= 1
            return replace(batch, xyz=numbers.sign())

    batches = loader(samples, size=5, augment=Signs())
    for _ in range(2):
        found: dict[int, list[tuple[float, ...]]] = {row: [] for row in range(N)}
        for batch in (batch for _ in range(8) for batch in batches):
            for row, signs in zip(batch.row.tolist(), batch.xyz.tolist(), strict=True):
                found[row].append(tuple(signs))
        assert all(len(set(signs)) == 8 for signs in found.values())
    assert len({tuple(signs) for signs in found.values()}) > N // 2  # the order differs between images
