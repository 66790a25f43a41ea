"""Views of a detector's boxes: a scene in front of the user's camera becomes one in front of the camera of a box.

The box is that of the visible silhouette in the user's image, distorted by its lens and cut off at its edges, with a
random error of size and place. `predict boxes=` makes the same view of a photograph.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from phd_exp.optics.virtual import Box, VirtualCamera, product, towards
from phd_exp.records.scenes import Pose, Scene, SceneObject, Vector
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import (
    NOTHING,
    Mask,
    cylinder_mask,
    in_camera_frame,
    optics,
    rotation_matrix,
    trace_pixels,
)
from phd_exp.rendering.sequences import quaternion_of
from phd_exp.rendering.triangles import Meshes

FEWEST = 24  # visible pixels of the object, where it fills the image: fewer are no detection
LEAST_VISIBLE = 0.1  # share of its silhouette
NEIGHBOURHOOD = 2.5  # of distractors, in radii of the object: two of them hide parts of a quarter of the objects


def view_of_box(scene: Scene, spec: DatasetSpec, rng: np.random.Generator, meshes: Meshes) -> Scene | None:
    """The scene of the user's camera as the virtual camera of the object's box shows it.

    None if too little of the object is visible, or the view of its box would be too wide.
    """
    assert spec.camera is not None
    K, lens = optics(spec.camera)
    first = _aimed(scene, meshes)
    hits = trace_pixels(first, meshes)
    camera = VirtualCamera(K, rotation_matrix(first.pose.rotation), first.f, first.S, lens)
    exact = _box(cylinder_mask(hits), camera, (spec.camera.width or 0, spec.camera.height or 0))
    if exact is None or exact[1] < max(FEWEST, LEAST_VISIBLE * (hits.surfaces[0] != NOTHING).sum()):
        return None
    left, top, right, bottom = exact[0]
    size, side = rng.uniform(*spec.box_size), np.array([right - left, bottom - top])
    middle = np.array([left + right, top + bottom]) / 2 + spec.box_shift * rng.uniform(-1, 1, 2) * side
    box = (*(middle - size * side / 2).tolist(), *(middle + size * side / 2).tolist())
    try:
        camera = VirtualCamera.of_box(K, box, float(spec.sensor_size), lens)
    except ValueError:
        return None
    changes = {"f": camera.f, "pose": _pose(camera.R), "real_camera": spec.camera, "real_box": box}
    view = scene.model_copy(update=changes)
    return view if all(_is_ahead(item, view.pose, meshes) for item in scene.objects if item.shape in meshes) else None


def _is_ahead(item: SceneObject, pose: Pose, meshes: Meshes) -> bool:
    """Whether the ball around a mesh is in front of a camera, as `Triangles.depths` requires."""
    return float(in_camera_frame(np.array(item.position), pose)[2]) > item.scale * meshes[item.shape].radius


def beside(item: SceneObject, radius: float, spec: DatasetSpec, rng: np.random.Generator) -> Vector:
    """A random place near the line of sight to an object of some radius (m), at a depth of z_range, scene frame."""
    R, reach = towards(np.array(item.position)), NEIGHBOURHOOD * _half_width(item, radius)
    x, y = rng.uniform(-reach, reach, 2)
    a, b, c = product(rng.uniform(*spec.z_range) * np.array([x, y, 1.0]), R).tolist()
    return a, b, c


def _half_width(item: SceneObject, radius: float) -> float:
    """Half the width of a ball's silhouette, in units of the focal length of a camera that faces it."""
    return math.tan(math.asin(min(radius / math.hypot(*item.position), 0.999)))


def _aimed(scene: Scene, meshes: Meshes) -> Scene:
    """The scene as a pinhole shows it that faces the object and whose image the object fills."""
    item = scene.objects[0]
    half_width = _half_width(item, item.scale * meshes["mesh"].radius)
    pose = _pose(towards(np.array(item.position)))
    return scene.model_copy(update={"f": scene.S / 2 / half_width, "pose": pose})


def _box(visible: Mask, camera: VirtualCamera, size: tuple[int, int]) -> tuple[Box, int] | None:
    """The box of visible pixels of a virtual camera in the real image, and how many of them are inside that image."""
    place = camera.grid(np.linspace(-1, 1, len(visible) + 1))  # the corners of pixels
    is_inside = ((place >= 0) & (place <= size)).all(axis=-1)
    used = np.zeros(is_inside.shape, bool)
    for rows, columns in ((0, 0), (0, 1), (1, 0), (1, 1)):
        used[rows : rows + len(visible), columns : columns + len(visible)] |= visible
    corners = place[used & np.isfinite(place).all(axis=-1)]
    if not len(corners):
        return None
    left, top, right, bottom = np.clip([*corners.min(0), *corners.max(0)], 0, [*size, *size]).tolist()
    n = int((visible & is_inside[1:, 1:] & is_inside[:-1, :-1]).sum())
    return ((left, top, right, bottom), n) if left < right and top < bottom else None


def _pose(R: NDArray[np.float64]) -> Pose:
    return Pose(rotation=quaternion_of(Rotation.from_matrix(R)), translation=(0.0, 0.0, 0.0))
