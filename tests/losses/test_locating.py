"""The losses of maps: least for the truth, finite everywhere, and what they say of cells."""

import math

import pytest
import torch
from torch.testing import assert_close

from phd_exp.geometry.camera import middles
from phd_exp.losses.locating import localisation_loss, segmentation_loss


def cells(rows: int, columns: int) -> torch.Tensor:
    return middles(rows, columns).movedim(-1, 0)


def heat_at(place: tuple[float, float], rows: int = 5, columns: int = 8) -> torch.Tensor:
    """A map that spreads a place over its four cells."""
    x, y = cells(rows, columns)
    share = (1 - (x - place[0]).abs() * columns / 2).clamp(0) * (1 - (y - place[1]).abs() * rows / 2).clamp(0)
    return share[None]


@pytest.mark.parametrize("place", [(0.1, -0.3), (0.125, 0.0), (-0.6, 0.55)])
def test_it_is_the_cross_entropy_with_cells_whose_mean_is_the_place(place: tuple[float, float]) -> None:
    share = heat_at(place)
    mean = torch.einsum("bij,cij->c", share, cells(5, 8))
    assert_close(mean, torch.tensor(place))
    found = localisation_loss((share + 1e-9).log(), torch.tensor([place]))
    entropy = -(share[share > 0] * share[share > 0].log()).sum()
    assert_close(found, entropy, atol=1e-5, rtol=0)
    elsewhere = localisation_loss((share + 1e-9).log(), torch.tensor([place]) + 0.3)
    assert elsewhere > found + 1


def test_a_map_that_knows_nothing_has_the_logarithm_of_the_cells() -> None:
    uniform = torch.full((3, 5, 8), -math.log(40))
    assert_close(localisation_loss(uniform, torch.zeros(3, 2)), torch.tensor(math.log(40)))


def test_beyond_the_image_the_border_is_the_place() -> None:
    scores = torch.randn(1, 5 * 8, generator=torch.Generator().manual_seed(0)).log_softmax(-1).view(1, 5, 8)
    corner = localisation_loss(scores, torch.tensor([[1.0, 1.0]]))
    assert_close(corner, -scores[0, -1, -1])
    assert torch.equal(localisation_loss(scores, torch.tensor([[7.0, 1e6]])), corner)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_bfloat16_autocast_rounds_nothing(scale: float) -> None:
    random = torch.Generator().manual_seed(0)
    log_heat = (scale * torch.randn(4, 40, generator=random)).log_softmax(-1).unflatten(1, (5, 8))
    v_p = 2 * torch.rand(4, 2, generator=random) - 1
    with torch.autocast("cpu", torch.bfloat16):
        value = localisation_loss(log_heat, v_p)
    assert value.isfinite()
    assert_close(value, localisation_loss(log_heat, v_p), rtol=0, atol=0)


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
