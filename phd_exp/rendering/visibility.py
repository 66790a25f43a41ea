"""How much of the cylinder an image shows: whole pixels, by what is met through their middles."""

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.scenes import Scene
from phd_exp.rendering.rays import NOTHING, Hits, pixel_middles, trace_points, window

Mask = NDArray[np.bool_]


def silhouettes(hits: Hits) -> Mask:
    """Pixels (S, S) that show any object at all, rows from the top."""
    return np.asarray((hits.surfaces != NOTHING).any(axis=0))


def cylinder_mask(hits: Hits) -> Mask:
    """Pixels (S, S) that show the first object, the cylinder, rows from the top."""
    return (hits.surfaces[0] != NOTHING) & (hits.depths[0] <= hits.depths.min(axis=0))


def visibility(hits: Hits) -> float:
    """Visible pixels of the cylinder over those it would show alone; 0 if it would show none."""
    alone = (hits.surfaces[0] != NOTHING).sum()
    return float(cylinder_mask(hits).sum() / alone) if alone else 0.0


def truncation(scene: Scene, hits: Hits) -> float:
    """Share of the pixels that the cylinder, alone, would take in an image without borders and that this one lacks.

    1 if it would take none anywhere.
    """
    cylinder = scene.model_copy(update={"objects": scene.objects[:1]})
    everywhere = trace_points(cylinder, *pixel_middles(*window(scene, scene.objects[0])))
    whole = (everywhere.surfaces[0] != NOTHING).sum()
    return float(1 - (hits.surfaces[0] != NOTHING).sum() / whole) if whole else 1.0
