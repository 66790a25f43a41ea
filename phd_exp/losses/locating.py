"""The losses of the maps of a locating backbone: where the object is, and which cells show it."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate


def segmentation_loss(
    log_odds: Float[Tensor, "batch rows columns"],
    mask: UInt8[Tensor, "batch mask_rows mask_columns"],
    weight: Float[Tensor, " batch"] | None = None,
) -> Float[Tensor, ""]:
    """The mean cross entropy between log odds and the true shares of the cells of a mask (0 to 255), in nats.

    Where the mask's cells are larger or smaller, the log odds are averaged or repeated. `weight` is a factor of the
    cross entropy of each sample; the mean is over all samples.
    """
    odds = interpolate(log_odds[:, None], size=mask.shape[1:], mode="area")[:, 0]
    weights = None if weight is None else weight.to(odds)[:, None, None]
    return binary_cross_entropy_with_logits(odds, mask.to(odds) / 255, weights)


def localisation_loss(
    log_heat: Float[Tensor, "batch rows columns"], v_p: Float[Tensor, "batch 2"]
) -> Float[Tensor, ""]:
    """The mean cross entropy between a map and the cells around the true place, in nats.

    The truth is distributed over the four nearest cells with bilinear weights, so that the mean of their centres is
    the place; a place beyond the outermost centres belongs to these. The gradient of the map's mean alone takes
    thousands of steps to find an object that differs from others by its shape only, as in `occl`.

    Args:
        log_heat: log probabilities of the cells of a grid over the image, which reaches from -1 to 1.
        v_p: projected positions (x, y).

    Source: own design.
    """
    rows, columns = log_heat.shape[1:]
    y, x = _shares(v_p[:, 1], rows), _shares(v_p[:, 0], columns)
    # no einsum, which autocast would round to bfloat16
    return -(log_heat * y[:, :, None] * x[:, None, :]).sum((1, 2)).mean()


def _shares(place: Float[Tensor, " batch"], n: int) -> Float[Tensor, "batch n"]:
    """Linear weights of a place for n cells between -1 and 1; they sum to 1."""
    cell = ((place + 1) * n / 2 - 0.5).clamp(0, n - 1)
    return (1 - (cell[:, None] - torch.arange(n).to(cell)).abs()).clamp(min=0)
