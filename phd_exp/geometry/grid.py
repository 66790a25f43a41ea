"""Grids over an image, whose sides reach from -1 to 1 as the projected position v_p does."""

import torch
from jaxtyping import Float
from torch import Tensor


def middles(rows: int, columns: int) -> Float[Tensor, "rows columns 2"]:
    """The middles (x, y) of the cells of a grid, or of pixels where there are as many of these."""
    y, x = ((2 * torch.arange(n) + 1) / n - 1 for n in (rows, columns))
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
