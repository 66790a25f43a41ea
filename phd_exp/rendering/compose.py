"""A picture: light as the path tracer finds it, edges by geometry, before a backdrop that is a formula.

The tracer renders only the box around the objects, and its pixels are taken only where an object is seen. All else is
the formula: the box leaves no seam that could tell where the objects are.
"""

import numpy as np

from phd_exp.records.scenes import Backdrop, Scene
from phd_exp.rendering.antialias import smoothed
from phd_exp.rendering.blender import Box, Renderer
from phd_exp.rendering.pixels import Light, Pixels, encoded
from phd_exp.rendering.rays import NOTHING, Hits, Mask

MARGIN = 4  # px around the objects that the denoiser sees, for what it does along the rim of its image


def take_picture(renderer: Renderer, scene: Scene, hits: Hits) -> Pixels:
    """Image (S, S, 3) of a scene whose pixels' rays have been traced; sRGB, rows from the top."""
    light = backdrop_light(scene.backdrop, scene.S)
    first = hits.first
    shown = first != NOTHING
    if not shown.any():
        return encoded(light)
    box = box_around(shown, MARGIN)
    inside = (slice(box.top, box.bottom), slice(box.left, box.right))
    light[inside] = np.where(shown[inside][..., None], renderer.render(scene, box), light[inside])
    return encoded(smoothed(light, first, scene))


def backdrop_light(backdrop: Backdrop, side: int) -> Light:
    """The backdrop alone (S, S, 3), linear light."""
    middles = (np.arange(side) + 0.5) / side
    x, y = middles - backdrop.centre[0], middles - backdrop.centre[1]
    light = backdrop.level * (1 - backdrop.falloff * (x[None, :] ** 2 + y[:, None] ** 2))
    return np.repeat(light[..., None], 3, axis=-1)


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
