"""The same scene from another camera at the same place: its image and its labels follow exactly.

A turn, a mirror and a longer focal length change any image by a homography.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from phd_exp.geometry.camera import Camera

EIGHT = tuple(product((1.0, -1.0), repeat=3))
"""The signs of all eight `symmetries`, the identity first."""


@dataclass(frozen=True)
class Motion:
    """Cameras turned or mirrored about their centres, with other focal lengths: v' = R v and f' = zoom f.

    Args:
        R: orthogonal matrices from the frame of the old camera to that of the new one; a reflection mirrors.
        zoom: the new focal length over the old one.

    Source: own derivation; both cameras are pinholes with one centre and square images of one side.
    """

    R: Float[Tensor, "batch 3 3"]
    zoom: Float[Tensor, " batch"]

    def camera(self, camera: Camera) -> Camera:
        """The new cameras."""
        return Camera.unchecked(self.zoom * camera.f, camera.S)

    def position(self, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3"]:
        """Positions (metres) in the frames of the new cameras."""
        return (self.R @ xyz[..., None]).squeeze(-1)

    def origin(self, pixel: Float[Tensor, "*#places 2"], camera: Camera) -> Float[Tensor, "batch *places 2"]:
        """The place in the old images of a pixel of the new ones.

        Both are relative to the middle of the image, in units of S/2: from -1 to 1 inside the image.
        """
        half = (camera.S / 2 / camera.f).reshape(-1, *[1] * pixel.ndim)
        zoom = self.zoom.reshape(half.shape)
        xy = pixel * half / zoom
        ray = torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)
        old = torch.einsum("bji,b...j->b...i", self.R, ray)
        return old[..., :2] / old[..., 2:] / half

    def where(self, chosen: Bool[Tensor, " batch"], other: "Motion") -> "Motion":
        """This motion for the chosen elements, the other one for the rest."""
        R = torch.where(chosen[:, None, None], self.R, other.R)
        return Motion(R, torch.where(chosen, self.zoom, other.zoom))

    def after(self, first: "Motion") -> "Motion":
        """The composition of the first motion and then this one."""
        return Motion(self.R @ first.R, self.zoom * first.zoom)


def symmetries(numbers: Float[Tensor, "batch 3"]) -> Motion:
    """The eight turns and mirrors that map pixels to pixels, from the signs of three numbers.

    The first two mirror the axes, the third exchanges them.
    """
    sign = torch.where(numbers < 0, -1.0, 1.0).to(numbers.dtype)
    identity = torch.eye(3, dtype=numbers.dtype, device=numbers.device)
    exchange = identity[[1, 0, 2]]
    mirror = torch.diag_embed(torch.cat([sign[:, :2], torch.ones_like(sign[:, :1])], dim=-1))
    R = mirror @ torch.where(numbers[:, 2, None, None] < 0, exchange, identity)
    return Motion(R, torch.ones_like(numbers[:, 0]))


def turned(image: UInt8[Tensor, "*batch side side n"], signs: Iterable[float]) -> UInt8[Tensor, "*batch side side n"]:
    """Images after one of the `symmetries`, given its three signs; pixels are moved, none is interpolated."""
    x, y, exchange = (sign < 0 for sign in signs)
    image = image.transpose(-3, -2) if exchange else image
    return image.flip([axis for axis, wanted in ((-2, x), (-3, y)) if wanted]) if x or y else image


def small_turns(numbers: Float[Tensor, "batch 4"], largest_zoom: float, camera: Camera) -> Motion:
    """Turns and zooms after which the old image still contains the whole new one.

    The zoom lies between 1 and `largest_zoom`. It allows a roll about the optical axis up to the angle theta with
    cos theta + sin theta = zoom; the remaining room allows a turn of the axis.

    Args:
        numbers: from -1 to 1, for zoom (magnitude only), roll and the two turns of the axis.
        largest_zoom: at least 1; sqrt(2) allows any roll.
        camera: the old cameras.

    Source: own derivation; a corner of a square turned by theta is cos theta + sin theta half sides from its middle.
    """
    zoom = 1 + (largest_zoom - 1) * numbers[:, 0].abs()
    most = (zoom.square() - 1).clamp(max=1).asin() / 2
    roll = most * numbers[:, 1]
    reach = (roll.cos() + roll.sin().abs()) / zoom
    # perspective moves corners by the square of the half field, a few per cent; this room stays free
    half = camera.S / 2 / camera.f
    room = ((1 - reach) - 2 * half.square()).clamp(min=0)
    tilt = (half * room)[:, None] * numbers[:, 2:]
    return Motion(_rotation(roll, tilt), zoom)


def _rotation(roll: Float[Tensor, " batch"], tilt: Float[Tensor, "batch 2"]) -> Float[Tensor, "batch 3 3"]:
    """Roll about z after a turn of the axis by the tangents `tilt` towards x and y."""
    z = torch.cat([tilt, torch.ones_like(tilt[:, :1])], dim=-1)
    z = z / z.norm(dim=-1, keepdim=True)
    cos, sin, zero = roll.cos(), roll.sin(), torch.zeros_like(roll)
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], dim=-1).unflatten(-1, (3, 3))
    return turn @ smallest_rotation(z)


def smallest_rotation(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation about an axis in the image plane (no roll) that maps a unit vector (z > 0) to (0, 0, 1).

    For (a, b, c) it is [[1 - a^2/(1+c), -ab/(1+c), -a], [-ab/(1+c), 1 - b^2/(1+c), -b], [a, b, c]].

    Source: Rodrigues' formula for the axis (b, -a, 0).
    """
    a, b, c = direction.unbind(-1)
    first = torch.stack([1 - a * a / (1 + c), -a * b / (1 + c), -a], dim=-1)
    second = torch.stack([-a * b / (1 + c), 1 - b * b / (1 + c), -b], dim=-1)
    return torch.stack([first, second, direction], dim=-2)
