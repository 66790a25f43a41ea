"""What a backbone that says where the object is learns besides the model's own loss."""

import torch
from jaxtyping import Float
from torch import Tensor


def localisation_loss(
    log_heat: Float[Tensor, "batch rows columns"], v_p: Float[Tensor, "batch 2"]
) -> Float[Tensor, ""]:
    """The mean cross entropy of a map and the cells about the true place, in nats.

    The truth is spread over the four cells about it so that the mean of their middles is the place, for one that lies
    between them; one beyond the outermost middles belongs to those. Where an object is unlike the others in a picture
    by its shape alone, as in `occl`, the gradient of a map's mean alone takes thousands of steps to find it.

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
    """How much of a place each of n cells between -1 and 1 has; they sum to 1."""
    cell = ((place + 1) * n / 2 - 0.5).clamp(0, n - 1)
    return (1 - (cell[:, None] - torch.arange(n).to(cell)).abs()).clamp(min=0)
