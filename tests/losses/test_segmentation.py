"""The segmentation loss: cross entropy with shares of cells, also between grids of other sizes."""

import torch
from torch.testing import assert_close

from phd_exp.losses.locating import segmentation_loss

MASK = torch.tensor([[[0, 255, 51, 0], [0, 255, 255, 0]]], dtype=torch.uint8)


def entropy(share: torch.Tensor) -> torch.Tensor:
    return -(torch.xlogy(share, share) + torch.xlogy(1 - share, 1 - share)).mean()


def test_the_true_shares_have_their_entropy_and_others_more() -> None:
    share = MASK.double() / 255
    odds = share.logit(1e-9)
    least = segmentation_loss(odds, MASK)
    assert_close(least, entropy(share), atol=1e-7, rtol=0)
    for change in (-0.1, 0.1):
        assert segmentation_loss(odds + change, MASK) > least


def test_a_finer_map_is_averaged_and_a_coarser_one_repeated() -> None:
    odds = torch.randn(1, 2, 4)
    here = segmentation_loss(odds, MASK)
    noise = torch.tensor([1.0, -1.0]).repeat(4)
    finer = odds.repeat_interleave(2, 1).repeat_interleave(2, 2) + noise
    assert_close(segmentation_loss(finer, MASK), here)
    assert_close(segmentation_loss(odds, MASK.repeat_interleave(2, 1).repeat_interleave(2, 2)), here)


def test_a_sample_of_weight_zero_adds_nothing_to_the_mean() -> None:
    odds, masks = torch.randn(2, 2, 4), MASK.expand(2, -1, -1)
    both = segmentation_loss(odds, masks, torch.tensor([1.0, 0.0]))
    assert_close(both, segmentation_loss(odds[:1], MASK) / 2)
    assert_close(segmentation_loss(odds, masks, torch.ones(2)), segmentation_loss(odds, masks))
