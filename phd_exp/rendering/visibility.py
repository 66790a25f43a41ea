"""Which pixels show the cylinder: analytic ray casting, one ray through the middle of each pixel.

A pinhole ray is v = z (u, w, 1). In an object's own frame, stretched so that the object fills [-1, 1]^3, it
is still a straight line with the same parameter z: every object is one of three unit solids, and its depth is
where the line enters.
"""

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.scenes import Scene, SceneObject

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


def depth_maps(scene: Scene) -> Image:
    """Depth z (objects, S, S), m, at which the ray of each pixel meets each object; infinity where it does not."""
    rays = _view_rays(scene)
    return np.stack([_depth_map(item, rays) for item in scene.objects])


def silhouettes(depths: Image) -> Mask:
    """Pixels (S, S) that show any object at all, rows from the top."""
    return np.asarray(np.isfinite(depths).any(axis=0))


def cylinder_mask(depths: Image) -> Mask:
    """Pixels (S, S) that show the first object, the cylinder, rows from the top."""
    return np.isfinite(depths[0]) & (depths[0] <= depths.min(axis=0))


def visibility(depths: Image) -> float:
    """Visible pixels of the cylinder over those it would show alone; 0 if it would show none."""
    alone = np.isfinite(depths[0]).sum()
    return float(cylinder_mask(depths).sum() / alone) if alone else 0.0


def _depth_map(item: SceneObject, rays: Image) -> Image:
    to_unit = rotation_matrix(item.rotation).T / (0.5 * item.scale * np.array(item.dimensions))[:, None]
    origin = -to_unit @ np.array(item.position)
    enter_and_leave = {"cylinder": _cylinder, "cube": _slabs, "sphere": _ball}[item.shape]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = enter_and_leave(origin, rays @ to_unit.T)
        # An interval whose ends are NaN or reversed is empty; what lies behind the camera is not seen.
        hit = (enter <= leave) & (enter > 0)
    return np.where(hit, enter, np.inf)


def rotation_matrix(quaternion: tuple[float, float, float, float]) -> Image:
    """Matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _view_rays(scene: Scene) -> Image:
    """Ray directions (S, S, 3) with z = 1; pixel (column c, row r) has its middle at (c + 1/2, r + 1/2)."""
    middles = (np.arange(scene.S) + 0.5 - scene.S / 2) / scene.f
    u, w = np.meshgrid(middles, middles)
    return np.stack([u, w, np.ones_like(u)], axis=-1)


def _slabs(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Interval of the parameter within |coordinate| <= 1, for all coordinates given."""
    one, two = (-1 - origin) / rays, (1 - origin) / rays
    return np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)


def _ball(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Interval of the parameter within the unit ball of the coordinates given; NaN where the line misses."""
    a, b, c = (rays * rays).sum(axis=-1), rays @ origin, origin @ origin - 1
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _cylinder(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Where an infinite round column and the slab between the caps overlap."""
    side_in, side_out = _ball(origin[:2], rays[..., :2])
    cap_in, cap_out = _slabs(origin[2:], rays[..., 2:])
    return np.maximum(side_in, cap_in), np.minimum(side_out, cap_out)
