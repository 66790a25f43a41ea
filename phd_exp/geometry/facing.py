"""The virtual cameras of boxes as a graph of torch, for export; `optics.virtual` has them in numpy."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from phd_exp.geometry.motion import smallest_rotation


def facing(
    K: Float[Tensor, "3 3"], boxes: Float[Tensor, "boxes 4"], S: int, largest_f: float
) -> tuple[Float[Tensor, "boxes 3 3"], Float[Tensor, " boxes"]]:
    """R and f of the virtual cameras of boxes in the image of a pinhole: `VirtualCamera.of_box` as a graph.

    f is NaN where that raises ValueError, and for K and boxes that are not finite.
    """
    lower, upper = boxes.tensor_split(2, dim=-1)
    half, focal_lengths = (upper - lower) / 2, K.diagonal()[:2]
    middle = pad((lower + half - K[:2, 2]) / focal_lengths, (0, 1), value=1)
    length = middle.norm(dim=-1, keepdim=True)
    R = smallest_rotation(middle / length)
    signs = torch.tensor([[-1, -1], [1, -1], [-1, 1], [1, 1]]).to(half)
    # from the middle to the corners, since differences of their directions would lose the digits of small boxes
    corners = (signs * half[:, None] / focal_lengths) @ R[..., :2].mT
    ahead = length + corners[..., 2]
    half_width = (corners[..., :2] / ahead[..., None]).abs().amax((1, 2)).clamp_min(S / (2 * largest_f))
    nearest = R[:, 2, 2] - half_width * R[:, :2, 2].abs().sum(-1)  # z of a corner of the view in the real frame
    is_view = (ahead > 0).all(-1) & (nearest > 0) & half_width.isfinite()
    return R, torch.where(is_view, S / (2 * half_width), torch.nan)


def pixel_corners(
    K: Float[Tensor, "3 3"],
    boxes: Float[Tensor, "boxes 4"],
    R: Float[Tensor, "boxes 3 3"],
    f: Float[Tensor, " boxes"],
    S: int,
) -> tuple[Float[Tensor, "boxes 2"], Float[Tensor, "boxes places places 2"]]:
    """Pixels of the real image at the corners of the pixels of each virtual image, as `data.crops.corners_of`.

    Returns whole numbers next to the middle of each box, and the corners relative to these. Corners are computed from
    the middle, so their rounding errors are those of the distance to it.
    """
    lower, upper = boxes.tensor_split(2, dim=-1)
    half = (upper - lower) / 2
    origin = (lower + half).floor()
    along = torch.arange(S + 1, dtype=K.dtype) - S / 2
    y, x = torch.meshgrid(along, along, indexing="ij")
    x, y = ((value / f[:, None, None])[..., None] for value in (x, y))
    right, down, middle = R[:, None, None].unbind(-2)  # the axes of the virtual cameras
    slope = middle[..., :2] / middle[..., 2:]
    across = x * (right[..., :2] - slope * right[..., 2:]) + y * (down[..., :2] - slope * down[..., 2:])
    away = across / (x * right[..., 2:] + y * down[..., 2:] + middle[..., 2:])
    return origin, (lower - origin + half)[:, None, None] + K.diagonal()[:2] * away
