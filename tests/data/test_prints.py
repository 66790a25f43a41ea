"""Random prints on the objects of training samples, and nearly plain backdrops behind them."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from phd_exp.data.backdrops import BACKDROP_NUMBERS, Backdrops, before_others
from phd_exp.data.batches import Batch, Exchange
from phd_exp.data.prints import GREY, PRINT_NUMBERS, printed

SIDE, N, HALF = 32, 40, 16


def scene(level: int) -> tuple[Backdrops, Batch]:
    """Samples of an object of one level in the left half of images whose upper quarter is beyond the user's image."""
    torch.manual_seed(0)
    empty = torch.randint(0, 256, (N, SIDE, SIDE, 3), dtype=torch.uint8)
    empty[:, : SIDE // 4] = GREY
    clear = torch.full((N, SIDE, SIDE), 255, dtype=torch.uint8)
    clear[:, :, :HALF] = clear[:, : SIDE // 4] = 0
    image, row = empty.clone(), torch.randperm(N)
    image[:, SIDE // 4 :, :HALF] = level
    return Backdrops(empty, clear), Batch(image[row], torch.rand(N, 3), torch.rand(N), float(SIDE), row)


def numbers(columns: int) -> torch.Tensor:
    return 2 * torch.rand(N, columns, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1


def print_on(level: int, **fixed: float) -> tuple[Batch, Batch]:
    """The samples before and after prints; `strength` is from -1 to 1."""
    backdrops, batch = scene(level)
    draw = numbers(PRINT_NUMBERS)
    for strength in fixed.values():
        draw[:, 6] = strength
    return batch, Exchange(backdrops, printed, PRINT_NUMBERS, 1.0, None)(batch, draw)


def test_a_print_changes_the_object_alone() -> None:
    before, after = print_on(60)
    changed = (after.image != before.image).any(-1)
    assert not changed[:, : SIDE // 4].any()
    assert not changed[:, :, HALF:].any()
    assert changed[:, SIDE // 4 :, :HALF].float().mean() > 0.8
    assert replace(after, image=before.image) == before


def test_a_print_multiplies_the_light_by_up_to_four_and_down_to_a_quarter() -> None:
    part = (slice(None), slice(SIDE // 4, None), slice(HALF))
    factors = {level: print_on(level, strength=1.0)[1].image[part] / level for level in (40, 60)}
    for level, factor in factors.items():
        assert factor.min() >= 1 / 4 - 1 / level
        assert factor.max() <= 4 + 1 / level
        assert factor.min() < 0.3
        assert factor.max() > 3
    torch.testing.assert_close(factors[40], factors[60], rtol=0, atol=0.05)  # the print does not depend on the object


def test_a_print_without_strength_is_none() -> None:
    before, after = print_on(60, strength=-1.0)
    assert torch.equal(after.image, before.image)


@pytest.mark.parametrize("plain", [0.0, 0.5, 1.0])
def test_a_share_of_other_backdrops_is_nearly_plain(plain: float) -> None:
    backdrops, batch = scene(60)
    exchange = Exchange(backdrops, partial(before_others, plain=plain), BACKDROP_NUMBERS, 1.0, None)
    new = exchange(batch, numbers(BACKDROP_NUMBERS)).image[:, SIDE // 4 :, HALF:].float()
    deviation, mean = torch.std_mean(new, (1, 2, 3))
    is_plain = deviation < 40  # half of that of random levels
    assert is_plain.float().mean() == pytest.approx(plain, abs=0.15)
    if plain:
        assert mean[is_plain].std() > 50  # of uniform brightness
