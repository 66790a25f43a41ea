"""Analytic ray casting: which surface a ray meets first, how far away, and how much of the cylinder shows.

A pinhole ray is v = z (u, w, 1). In an object's own frame, stretched so that the object fills [-1, 1]^3, it
is still a straight line with the same parameter z: every object is one of three unit solids, and its depth is
where the line enters.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.scenes import Pose, Scene, SceneObject
from phd_exp.rendering.rotations import rotation_matrix

Image = NDArray[np.float64]
Labels = NDArray[np.int8]
Mask = NDArray[np.bool_]

FACES = 8  # at most that many smooth faces on one object
NOTHING = 0  # the label of a ray that meets no object


@dataclass(frozen=True)
class Hits:
    """What rays (...) meet, for each object were it alone.

    Attributes:
        depths: z (objects, ...), m; infinity where a ray misses the object.
        surfaces: the number in the scene of the smooth face (objects, ...) that is met; NOTHING where missed.
    """

    depths: Image
    surfaces: Labels

    @property
    def first(self) -> Labels:
        """The surface (...) that is met first: what a camera sees."""
        nearest = self.depths.argmin(axis=0)
        return np.take_along_axis(self.surfaces, nearest[None], axis=0)[0]


def trace_pixels(scene: Scene) -> Hits:
    """What the rays through the middles (c + 1/2, r + 1/2) of all pixels (column c, row r) meet: (S, S)."""
    shape = (len(scene.objects), scene.S, scene.S)
    hits = Hits(np.full(shape, np.inf), np.full(shape, NOTHING, np.int8))
    for number, item in enumerate(scene.objects):
        rows, columns = (_clipped(span, scene.S) for span in window(scene, item))
        if rows and columns:
            x, y = pixel_middles(rows, columns)
            place = (number, slice(rows.start, rows.stop), slice(columns.start, columns.stop))
            hits.depths[place], hits.surfaces[place] = _cast(scene, number, x, y)
    return hits


def trace_points(scene: Scene, x: Image, y: Image) -> Hits:
    """What the rays through some points (...) of the image meet: x to the right, y down, px."""
    shape = (len(scene.objects), *x.shape)
    hits = Hits(np.full(shape, np.inf), np.full(shape, NOTHING, np.int8))
    for number, item in enumerate(scene.objects):
        rows, columns = window(scene, item)
        near = (x >= columns.start) & (x <= columns.stop) & (y >= rows.start) & (y <= rows.stop)
        hits.depths[number, near], hits.surfaces[number, near] = _cast(scene, number, x[near], y[near])
    return hits


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


def pixel_middles(rows: range, columns: range) -> tuple[Image, Image]:
    """Coordinates x and y (rows, columns) of the middles of a rectangle of pixels."""
    x, y = np.meshgrid(np.asarray(columns) + 0.5, np.asarray(rows) + 0.5)
    return x, y


def in_camera_frame(position: Image, pose: Pose) -> Image:
    """A point (3,) of the scene's frame as the camera sees it, m."""
    return rotation_matrix(pose.rotation) @ position + np.array(pose.translation)


def window(scene: Scene, item: SceneObject) -> tuple[range, range]:
    """Rows and columns, not only of the image, that hold an object's silhouette: those of a ball around it.

    The ball's shadow on an axis of the image reaches from tan(angle - width) to tan(angle + width).
    """
    x, y, z = in_camera_frame(np.array(item.position), scene.pose)
    radius = 0.5 * item.scale * math.hypot(*item.dimensions)
    if z <= radius:  # beside or around the camera: nothing is known but the image's own borders
        return range(scene.S), range(scene.S)
    return _shadow(y, z, radius, scene), _shadow(x, z, radius, scene)


def _shadow(off_axis: float, z: float, radius: float, scene: Scene) -> range:
    angle, width = math.atan2(off_axis, z), math.asin(radius / math.hypot(off_axis, z))
    first, last = (
        scene.f * math.tan(min(max(angle + side, -1.5), 1.5)) + scene.S / 2 for side in (-width, width)
    )
    return range(math.floor(first), math.ceil(last))


def _clipped(span: range, side: int) -> range:
    return range(max(span.start, 0), min(span.stop, side))


def _cast(scene: Scene, number: int, x: Image, y: Image) -> tuple[Image, Labels]:
    """Depth (...) at which the rays through points (...) of the image enter one object, and through which surface."""
    item = scene.objects[number]
    rotation = rotation_matrix(scene.pose.rotation) @ rotation_matrix(item.rotation)
    to_unit = rotation.T / (0.5 * item.scale * np.array(item.dimensions))[:, None]
    origin = -to_unit @ in_camera_frame(np.array(item.position), scene.pose)
    rays = np.ones((*x.shape, 3))
    rays[..., 0], rays[..., 1] = (x - scene.S / 2) / scene.f, (y - scene.S / 2) / scene.f
    meet = {"cylinder": _cylinder, "cube": _cube, "sphere": _sphere}[item.shape]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave, face = meet(origin, rays @ to_unit.T)
        # An interval whose ends are NaN or reversed is empty; what lies behind the camera is not seen.
        hit = (enter <= leave) & (enter > 0)
    return np.where(hit, enter, np.inf), np.where(hit, 1 + FACES * number + face, NOTHING).astype(np.int8)


def _slabs(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Intervals (..., axes) of the parameter within |coordinate| <= 1."""
    one, two = (-1 - origin) / rays, (1 - origin) / rays
    return np.minimum(one, two), np.maximum(one, two)


def _ball(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Interval of the parameter within the unit ball of the coordinates given; NaN where the line misses."""
    a, b, c = (rays * rays).sum(axis=-1), rays @ origin, origin @ origin - 1
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _sphere(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    enter, leave = _ball(origin, rays)
    return enter, leave, np.zeros_like(enter)


def _cube(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    """Two faces an axis: which one of them a ray enters by follows from its direction."""
    enter, leave = _slabs(origin, rays)
    axis = enter.argmax(axis=-1)
    rising = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0
    return enter.max(axis=-1), leave.min(axis=-1), 2 * axis + rising


def _cylinder(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    """Where an infinite round column and the slab between the caps overlap: the side, and two caps."""
    side_in, side_out = _ball(origin[:2], rays[..., :2])
    cap_in, cap_out = _slabs(origin[2], rays[..., 2])
    face = np.where(side_in >= cap_in, 0, 1 + (rays[..., 2] > 0))
    return np.maximum(side_in, cap_in), np.minimum(side_out, cap_out), face
