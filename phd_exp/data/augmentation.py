"""Augmentation: the same scenes through other cameras and in other light, with exact labels."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample

from phd_exp.data.batches import SIGNS, Batch
from phd_exp.data.photometry import Photometry, levels, on
from phd_exp.geometry.camera import middles
from phd_exp.geometry.motion import Motion, small_turns, symmetries

TURN, COLOURS = 4, 3  # numbers of a rotation and zoom, and of an order of the channels


@dataclass(frozen=True)
class Augmentation:
    """Random changes of the samples of a batch.

    Args:
        symmetries: apply one of the eight rotations and reflections that map pixels to pixels.
        largest_zoom: largest factor of a small rotation and zoom of the camera; 1 for none.
        colours: permute the three colour channels.
        photometry: changes of light and image quality.
    """

    n_numbers: ClassVar[int] = SIGNS + TURN + COLOURS + Photometry.n_numbers
    symmetries: bool
    largest_zoom: float
    colours: bool
    photometry: Photometry

    @property
    def changes_anything(self) -> bool:
        """Whether any change can be drawn."""
        return self.symmetries or self.largest_zoom > 1 or self.colours or self.photometry.changes_anything

    def __call__(self, batch: Batch, numbers: Float[Tensor, "batch n_numbers"]) -> Batch:
        """The samples, changed by uniform numbers from -1 to 1.

        A rotation and zoom that would move the object out of the image is skipped; the symmetry is kept.
        """
        signs, turn, order, light = numbers.split([SIGNS, TURN, COLOURS, Photometry.n_numbers], dim=1)
        if self.photometry.changes_anything:
            batch = replace(batch, image=self.photometry(batch.image, light))
        signs = signs if self.symmetries else torch.ones_like(signs)
        channels = order.argsort(dim=1) if self.colours else torch.arange(COLOURS).expand_as(order)
        symmetry = symmetries(signs.to(batch.f))
        if self.largest_zoom > 1:
            motion = small_turns(turn.to(batch.f), self.largest_zoom, batch.camera).after(symmetry)
            motion = motion.where(motion.camera(batch.camera).contains(motion.position(batch.xyz)), symmetry)
            batch, signs = moved(batch, motion), torch.ones_like(signs)
        else:
            batch = replace(batch, xyz=symmetry.position(batch.xyz))
        image, mask = rearranged(batch.image, signs.numpy(), channels.numpy()), batch.mask
        if mask is not None:
            mask = rearranged(mask[..., None], signs.numpy(), 0 * channels[:, :1].numpy())[..., 0]
        return replace(batch, image=image, mask=mask)


def rearranged(
    image: UInt8[Tensor, "batch side side channels"],
    signs: Float[np.ndarray, "batch 3"],
    channels: Int[np.ndarray, "batch n"],
) -> UInt8[Tensor, "batch side side channels"]:
    """The images `moved` by `symmetries` of these signs, without interpolation; with their channels in that order."""
    rows = np.column_stack([signs < 0, channels])
    code = rows @ COLOURS ** np.arange(rows.shape[1])  # `unique` of whole rows takes five times as long
    _, first, kind = np.unique(code, return_index=True, return_inverse=True)
    order, counts = kind.argsort(kind="stable"), np.bincount(kind).tolist()
    sorted_images = image.index_select(0, on(image, order))
    result = torch.empty_like(sorted_images)
    parts = zip(rows[first].tolist(), sorted_images.split(counts), result.split(counts), strict=True)
    for (across, down, is_exchanged, *of_channels), part, out in parts:
        mirrored = ((2 - is_exchanged, across), (1 + is_exchanged, down))
        part = part.flip([axis for axis, is_mirrored in mirrored if is_mirrored])
        part = part.transpose(1, 2) if is_exchanged else part
        torch.stack([part[..., channel] for channel in of_channels], dim=-1, out=out)
    return result.index_select(0, on(image, order.argsort()))


def moved(batch: Batch, motion: Motion) -> Batch:
    """The samples after a motion of the cameras: images interpolated bilinearly, the border repeated beyond it."""

    def resampled(images: UInt8[Tensor, "batch side side channels"]) -> UInt8[Tensor, "batch side side channels"]:
        side = images.shape[1]
        origin = motion.origin(middles(side, side).to(batch.f), batch.camera)
        values = grid_sample(
            images.permute(0, 3, 1, 2).to(origin.dtype), origin, padding_mode="border", align_corners=False
        )
        return levels(values).permute(0, 2, 3, 1).contiguous()

    mask = None if batch.mask is None else resampled(batch.mask[..., None])[..., 0]
    return replace(
        batch,
        image=resampled(batch.image),
        xyz=motion.position(batch.xyz),
        f=motion.camera(batch.camera).f,
        mask=mask,
    )
