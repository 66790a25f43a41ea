"""Which pixels show the cylinder: analytic ray casting, one ray through the middle of each pixel.

A pinhole ray is v = z (u, w, 1). In an object's own frame, stretched so that the object fills [-1, 1]^3, it
is still a straight line with the same parameter z: every object is one of three unit solids, and its depth is
where the line enters.
"""

import math

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.scenes import Pose, Scene, SceneObject
from phd_exp.rendering.rotations import rotation_matrix

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


def depth_maps(scene: Scene) -> Image:
    """Depth z (objects, S, S), m, at which the ray of each pixel meets each object; infinity where it does not."""
    depths = np.full((len(scene.objects), scene.S, scene.S), np.inf)
    for depth, item in zip(depths, scene.objects, strict=True):
        rows, columns = (_clipped(span, scene.S) for span in _window(scene, item))
        if rows and columns:
            depth[rows.start : rows.stop, columns.start : columns.stop] = _depths(scene, item, rows, columns)
    return depths


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


def truncation(scene: Scene, depths: Image) -> float:
    """Share of the cylinder's pixels, were it alone, that an image without borders would show and this one does not.

    1 if it would show none anywhere.
    """
    rows, columns = _window(scene, scene.objects[0])
    whole = np.isfinite(_depths(scene, scene.objects[0], rows, columns)).sum()
    return float(1 - np.isfinite(depths[0]).sum() / whole) if whole else 1.0


def in_camera_frame(position: Image, pose: Pose) -> Image:
    """A point (3,) of the scene's frame as the camera sees it, m."""
    return rotation_matrix(pose.rotation) @ position + np.array(pose.translation)


def _window(scene: Scene, item: SceneObject) -> tuple[range, range]:
    """Rows and columns, not only of the image, that hold an object's silhouette: those of a ball around it.

    The ball's shadow on an axis of the image reaches from tan(angle - width) to tan(angle + width).
    """
    x, y, z = in_camera_frame(np.array(item.position), scene.pose)
    radius = 0.5 * item.scale * math.hypot(*item.dimensions)
    if z <= radius:  # beside or around the camera: nothing is known but the image's own borders
        return range(scene.S), range(scene.S)
    rows, columns = (_shadow(off_axis, z, radius, scene) for off_axis in (y, x))
    return rows, columns


def _shadow(off_axis: float, z: float, radius: float, scene: Scene) -> range:
    angle, width = math.atan2(off_axis, z), math.asin(radius / math.hypot(off_axis, z))
    first, last = (
        scene.f * math.tan(min(max(angle + side, -1.5), 1.5)) + scene.S / 2 for side in (-width, width)
    )
    return range(math.floor(first), math.ceil(last))


def _clipped(span: range, side: int) -> range:
    return range(max(span.start, 0), min(span.stop, side))


def _depths(scene: Scene, item: SceneObject, rows: range, columns: range) -> Image:
    """Depth (rows, columns) at which the rays of some pixels meet one object."""
    rotation = rotation_matrix(scene.pose.rotation) @ rotation_matrix(item.rotation)
    to_unit = rotation.T / (0.5 * item.scale * np.array(item.dimensions))[:, None]
    origin = -to_unit @ in_camera_frame(np.array(item.position), scene.pose)
    enter_and_leave = {"cylinder": _cylinder, "cube": _slabs, "sphere": _ball}[item.shape]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = enter_and_leave(origin, _view_rays(scene, rows, columns) @ to_unit.T)
        # An interval whose ends are NaN or reversed is empty; what lies behind the camera is not seen.
        hit = (enter <= leave) & (enter > 0)
    return np.where(hit, enter, np.inf)


def _view_rays(scene: Scene, rows: range, columns: range) -> Image:
    """Ray directions (rows, columns, 3) with z = 1; pixel (column c, row r) has its middle at (c + 1/2, r + 1/2)."""
    u, w = ((np.asarray(span) + 0.5 - scene.S / 2) / scene.f for span in (columns, rows))
    rays = np.ones((len(w), len(u), 3))
    rays[..., 0], rays[..., 1] = u[None, :], w[:, None]
    return rays


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
