"""A picture: objects as the path tracer sees them, before a backdrop that is a formula.

The tracer renders only the box around the objects. Beyond the reach of its pixel filter from every silhouette a
picture shows nothing but the backdrop, which is written there exactly: the box leaves no seam that could tell where
the objects are, and the denoiser no trace along the rim of the image.
"""

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.scenes import Backdrop, Scene
from phd_exp.rendering.blender import Box, Pixels, Renderer
from phd_exp.rendering.visibility import Mask, silhouettes

REACH = 2  # px: the tracer's filter ends 0.75 px from a pixel's middle; one more for the mask's own rounding
MARGIN = 8  # px around the objects that the denoiser sees, for what it does along the rim of its image


def take_picture(renderer: Renderer, scene: Scene, depths: NDArray[np.float64]) -> Pixels:
    """Image (S, S, 3) of a scene whose depth maps (objects, S, S) are given; sRGB, rows from the top."""
    picture = backdrop_pixels(scene.backdrop, scene.S)
    near = grown(silhouettes(depths), REACH)
    if not near.any():
        return picture
    box = box_around(near, MARGIN)
    inside = (slice(box.top, box.bottom), slice(box.left, box.right))
    picture[inside] = np.where(near[inside][..., None], renderer.render(scene, box), picture[inside])
    return picture


def backdrop_pixels(backdrop: Backdrop, side: int) -> Pixels:
    """The backdrop alone (S, S, 3), as the tracer would show it."""
    middles = (np.arange(side) + 0.5) / side
    x, y = middles - backdrop.centre[0], middles - backdrop.centre[1]
    light = backdrop.level * (1 - backdrop.falloff * (x[None, :] ** 2 + y[:, None] ** 2))
    return np.repeat(_encode(light)[..., None], 3, axis=-1)


def grown(mask: Mask, reach: int) -> Mask:
    """The mask (S, S) with all pixels added that lie within `reach` columns and rows of it."""
    side = mask.shape[0]
    padded = np.pad(mask, reach)
    steps = range(2 * reach + 1)
    rows = np.logical_or.reduce([padded[step : step + side] for step in steps])
    return np.asarray(np.logical_or.reduce([rows[:, step : step + side] for step in steps]))


def box_around(mask: Mask, margin: int) -> Box:
    """The smallest box that holds a mask (S, S), which is not empty, and a margin, within the image."""
    side = mask.shape[0]
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return Box(
        left=max(int(columns[0]) - margin, 0),
        top=max(int(rows[0]) - margin, 0),
        right=min(int(columns[-1]) + 1 + margin, side),
        bottom=min(int(rows[-1]) + 1 + margin, side),
    )


def _encode(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Linear light to 8-bit sRGB (IEC 61966-2-1)."""
    light = light.clip(0, 1)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * signal + 0.5).astype(np.uint8)
