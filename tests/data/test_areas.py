"""Views of enlarged pixels: interpolated, to the pixels that the means over areas give."""

import math

import pytest
import torch

from phd_exp.data.areas import GREY, area_means, sums, view


@pytest.mark.parametrize("zoom", [1.0, 1.7, 6.0, 0.4])
@pytest.mark.parametrize("size", [(37, 50), (1, 1)], ids=str)
def test_a_view_is_the_mean_over_areas(size: tuple[int, int], zoom: float) -> None:
    """Also for a turned view, beyond the edges, where a corner is NaN, and where pixels are larger."""
    random = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (*size, 3), dtype=torch.uint8, generator=random)
    along = torch.arange(65, dtype=torch.float64) / zoom
    x, y = torch.meshgrid(along, along, indexing="xy")
    turn = math.radians(7)
    corners = (
        torch.stack([math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y], dim=-1) - 3
    )
    corners[-3:, -5:] = math.nan
    found = view(image, corners)
    assert torch.equal(found, area_means(sums(image), corners))
    assert (found[-2:, -4:] == GREY).all()
    assert (found != GREY).any()
