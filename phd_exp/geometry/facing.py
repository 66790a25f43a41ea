"""The virtual cameras of boxes as a graph of torch, for export; `optics.virtual` has them in numpy."""

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.geometry.motion import smallest_rotation


def facing(
    K: Float[Tensor, "3 3"], boxes: Float[Tensor, "boxes 4"], S: int, largest_f: float
) -> tuple[Float[Tensor, "boxes 3 3"], Float[Tensor, " boxes"]]:
    """R and f of the virtual cameras of boxes in the image of a pinhole: `VirtualCamera.of_box` as a graph.

    f is NaN where that raises ValueError, and for K and boxes that are not finite.
    """
    left, top, right, bottom = boxes.unbind(-1)
    pixels = [((left + right) / 2, (top + bottom) / 2), (left, top), (right, top), (left, bottom), (right, bottom)]
    places = (torch.stack([torch.stack(pixel, -1) for pixel in pixels], 1) - K[:2, 2]) / K.diagonal()[:2]
    directions = torch.cat([places, torch.ones_like(places[..., :1])], dim=-1)
    R = smallest_rotation(directions[:, 0] / directions[:, 0].norm(dim=-1, keepdim=True))
    corners = directions[:, 1:] @ R.mT
    half_width = (corners[..., :2] / corners[..., 2:]).abs().amax((1, 2)).clamp_min(S / (2 * largest_f))
    nearest = R[:, 2, 2] - half_width * R[:, :2, 2].abs().sum(-1)  # z of a corner of the view in the real frame
    is_view = (corners[..., 2] > 0).all(-1) & (nearest > 0) & half_width.isfinite()
    return R, torch.where(is_view, S / (2 * half_width), torch.nan)


def pixel_corners(
    K: Float[Tensor, "3 3"], R: Float[Tensor, "boxes 3 3"], f: Float[Tensor, " boxes"], S: int
) -> Float[Tensor, "boxes places places 2"]:
    """Pixels of the real image at the corners of the pixels of each virtual image, `VirtualCamera.corners`."""
    along = torch.arange(S + 1, dtype=K.dtype) - S / 2
    y, x = torch.meshgrid(along, along, indexing="ij")
    x, y = x / f[:, None, None], y / f[:, None, None]
    real = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ R[:, None]
    return K[:2, 2] + K.diagonal()[:2] * (real[..., :2] / real[..., 2:])
