"""Analytic ray casting: the first surface that a ray hits, its depth, and the visible share of the cylinder.

A pinhole ray is v = z (u, w, 1). In an object's own frame, scaled so that the object fills [-1, 1]^3, the ray is
still a straight line with the same parameter z. Every object is thus one of three unit solids, and its depth is the
parameter at which the line enters.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import VirtualCamera, product
from phd_exp.records.cameras import Calibration
from phd_exp.records.scenes import Pose, Scene, SceneObject
from phd_exp.rendering.pixels import Box
from phd_exp.rendering.triangles import NO_MESHES, Meshes

Image = NDArray[np.float64]
Labels = NDArray[np.int8]
Mask = NDArray[np.bool_]

FACES = 8  # at most that many smooth faces on one object
NOTHING = 0  # the label of a ray that hits no object


@dataclass(frozen=True)
class Hits:
    """The hits of rays (...) on each object, as if it were alone.

    Attributes:
        depths: z (objects, ...), m; infinity where a ray misses the object.
        surfaces: number in the scene of the smooth face (objects, ...) that is hit; NOTHING where missed.
    """

    depths: Image
    surfaces: Labels

    @property
    def first(self) -> Labels:
        """The surface (...) that is hit first, and which a camera therefore shows."""
        nearest = self.depths.argmin(axis=0)
        return np.take_along_axis(self.surfaces, nearest[None], axis=0)[0]


def trace_pixels(scene: Scene, meshes: Meshes = NO_MESHES) -> Hits:
    """The hits (S, S) of the rays through the middles (c + 1/2, r + 1/2) of all pixels (column c, row r)."""
    hits = _no_hits(scene, (scene.S, scene.S))
    for number, item in enumerate(scene.objects):
        if item.shape in meshes:
            hits.depths[number] = meshes[item.shape].depths(*_placed(scene, item), scene.f, scene.S)
            hits.surfaces[number] = np.where(np.isfinite(hits.depths[number]), 1 + FACES * number, NOTHING)
            continue
        box = window(scene, item).within(Box(0, 0, scene.S, scene.S))
        place = (number, *box.slices)
        hits.depths[place], hits.surfaces[place] = _cast(scene, number, *box.middles)
    if scene.real_camera:
        outside = beyond_edges(scene)
        hits.depths[:, outside], hits.surfaces[:, outside] = np.inf, NOTHING
    return hits


def beyond_edges(scene: Scene) -> Mask:
    """The pixels (S, S) of a view of a box that lie beyond the edges of the user's image."""
    if scene.real_camera is None:
        return np.zeros((scene.S, scene.S), bool)
    K, lens = optics(scene.real_camera)
    view = VirtualCamera(K, rotation_matrix(scene.pose.rotation), scene.f, scene.S, lens)
    return view.outside(scene.real_camera.width or 0, scene.real_camera.height or 0)


@lru_cache(maxsize=4)
def optics(camera: Calibration) -> tuple[Image, Lens]:
    """Camera matrix and lens of the user's camera; the lens keeps a table."""
    return camera.intrinsics, camera.lens


def trace_points(scene: Scene, x: Image, y: Image) -> Hits:
    """The hits (...) of the rays through points of the image: x to the right, y down, px."""
    hits = _no_hits(scene, x.shape)
    for number, item in enumerate(scene.objects):
        left, top, right, bottom = window(scene, item)
        near = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        hits.depths[number, near], hits.surfaces[number, near] = _cast(scene, number, x[near], y[near])
    return hits


def _no_hits(scene: Scene, shape: tuple[int, ...]) -> Hits:
    shape = (len(scene.objects), *shape)
    return Hits(np.full(shape, np.inf), np.full(shape, NOTHING, np.int8))


def cylinder_mask(hits: Hits, number: int = 0) -> Mask:
    """Pixels (S, S) that show the cylinder, the scene's first object, or another one; rows from the top."""
    return (hits.surfaces[number] != NOTHING) & (hits.depths[number] <= hits.depths.min(axis=0))


def visibility(hits: Hits) -> float:
    """Visible pixels of the cylinder over those visible without other objects; 0 if there are none."""
    alone = (hits.surfaces[0] != NOTHING).sum()
    return float(cylinder_mask(hits).sum() / alone) if alone else 0.0


def truncation(scene: Scene, hits: Hits, meshes: Meshes = NO_MESHES) -> float:
    """Share of the cylinder's pixels, in an image without borders or other objects, that lie outside this image.

    1 if the cylinder has no pixels at all.
    """
    whole = silhouette(scene, 0, meshes)[0].sum()
    return float(1 - (hits.surfaces[0] != NOTHING).sum() / whole) if whole else 1.0


def silhouette(
    scene: Scene, number: int = 0, meshes: Meshes = NO_MESHES, within: Box | None = None
) -> tuple[Mask, Box]:
    """Pixels of an object in an image without borders or other objects, those of a box around it; and this box.

    It is clipped to a given box, by default not.
    """
    item = scene.objects[number]
    if item.shape in meshes:
        place = (*_placed(scene, item), scene.f, scene.S)
        box = meshes[item.shape].window(*place)
        box = box.within(within or box)
        return np.isfinite(meshes[item.shape].depths(*place, box)), box
    box = window(scene, item)
    box = box.within(within or box)
    alone = scene.model_copy(update={"objects": scene.objects[number : number + 1]})
    return trace_points(alone, *box.middles).surfaces[0] != NOTHING, box


def _placed(scene: Scene, item: SceneObject) -> tuple[Image, Image]:
    """The map of an object's local frame to the camera's: a scaled rotation (3, 3), and a shift (3,), m."""
    turn = item.scale * product(rotation_matrix(scene.pose.rotation), rotation_matrix(item.rotation))
    return turn, in_camera_frame(np.array(item.position), scene.pose)


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


def in_camera_frame(position: Image, pose: Pose) -> Image:
    """A point (3,) of the scene's frame in the camera's frame, m."""
    return product(rotation_matrix(pose.rotation), position) + np.array(pose.translation)


def window(scene: Scene, item: SceneObject) -> Box:
    """A box, possibly outside the image, that contains an object's silhouette: that of a ball around it.

    The ball's projection on an axis of the image reaches from tan(angle - width) to tan(angle + width).
    """
    x, y, z = in_camera_frame(np.array(item.position), scene.pose)
    radius = 0.5 * item.scale * math.hypot(*item.dimensions)
    if z <= radius:  # next to or around the camera: only the image's borders bound the silhouette
        return Box(0, 0, scene.S, scene.S)
    (left, right), (top, bottom) = (_shadow(off_axis, z, radius, scene) for off_axis in (x, y))
    return Box(left, top, right, bottom)


def _shadow(off_axis: float, z: float, radius: float, scene: Scene) -> tuple[int, int]:
    angle, width = math.atan2(off_axis, z), math.asin(radius / math.hypot(off_axis, z))
    first, last = (scene.f * math.tan(min(max(angle + side, -1.5), 1.5)) + scene.S / 2 for side in (-width, width))
    return math.floor(first), math.ceil(last)


def _cast(scene: Scene, number: int, x: Image, y: Image) -> tuple[Image, Labels]:
    """Depth (...) at which the rays through points (...) of the image enter one object, and the surface."""
    item = scene.objects[number]
    rotation = product(rotation_matrix(scene.pose.rotation), rotation_matrix(item.rotation))
    to_unit = rotation.T / (0.5 * item.scale * np.array(item.dimensions))[:, None]
    origin = product(-to_unit, in_camera_frame(np.array(item.position), scene.pose))
    rays = np.stack([(x - scene.S / 2) / scene.f, (y - scene.S / 2) / scene.f, np.ones_like(x)])
    meet = {"cylinder": _cylinder, "cube": _cube, "sphere": _sphere}[item.shape]
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave, face = meet(origin, product(np.moveaxis(rays, 0, -1), to_unit.T))
        # an interval whose ends are NaN or reversed is empty; a camera shows nothing behind it
        hit = (enter <= leave) & (enter > 0)
    return np.where(hit, enter, np.inf), np.where(hit, 1 + FACES * number + face, NOTHING).astype(np.int8)


def _slabs(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Intervals (..., axes) of the parameter in which |coordinate| <= 1."""
    one, two = (-1 - origin) / rays, (1 - origin) / rays
    return np.minimum(one, two), np.maximum(one, two)


def _ball(origin: Image, rays: Image) -> tuple[Image, Image]:
    """Interval of the parameter inside the unit ball of the given coordinates; NaN where the line misses."""
    a, b, c = (rays * rays).sum(axis=-1), product(rays, origin), product(origin, origin) - 1
    root = np.sqrt(b * b - a * c)
    return (-b - root) / a, (-b + root) / a


def _sphere(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    enter, leave = _ball(origin, rays)
    return enter, leave, np.zeros_like(enter)


def _cube(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    """Each axis has two faces; the direction of a ray decides which one it enters."""
    enter, leave = _slabs(origin, rays)
    axis = enter.argmax(axis=-1)
    rising = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0
    return enter.max(axis=-1), leave.min(axis=-1), 2 * axis + rising


def _cylinder(origin: Image, rays: Image) -> tuple[Image, Image, Image]:
    """The intersection of an infinite round column and the slab between the caps: the side, and two caps."""
    side_in, side_out = _ball(origin[:2], rays[..., :2])
    cap_in, cap_out = _slabs(origin[2], rays[..., 2])
    face = np.where(side_in >= cap_in, 0, 1 + (rays[..., 2] > 0))
    return np.maximum(side_in, cap_in), np.minimum(side_out, cap_out), face
