"""Scenes of the user's mesh: those of the cylinder, with the mesh in its place and the world around it."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from phd_exp.optics.virtual import product, unit
from phd_exp.records.assets import PHOTOS
from phd_exp.records.scenes import SHAPES, Quaternion, Scene, SceneObject, Split, Surroundings, Vector
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.boxes import beside, view_of_box
from phd_exp.rendering.importing import in_blenders_axes
from phd_exp.rendering.looks import varied
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.resting import resting_turn
from phd_exp.rendering.sampling import (
    MOST_TRIES,
    SIZE,
    Purpose,
    Stream,
    draw_object,
    sample_scene,
    stream_of,
    uniform_rotation,
)
from phd_exp.rendering.sequences import quaternion_of, rotation_of
from phd_exp.rendering.triangles import Meshes, Triangles

Array = NDArray[np.float64]

REACH = SIZE * 0.5**0.5  # m, from the cylinder's centre to its rim
BRIGHTNESS = (0.5, 2.0)  # factors of a sky's light
LARGEST_SPAN = 8.0  # of a sky: 8 degrees, all that a long lens sees, are 23 pixels of Blender's panoramas
STRETCH = (math.log(0.25), math.log(1.5))  # of the sides of solids with varied looks
AGAIN = 10**9  # the number of a sample that is drawn again grows by this, beyond those of all samples
BESIDE = (1.0, 1.5)  # distance of copies, as a factor of that at which a plane between the two touches both
LEAST_SIDE = 0.4  # of a photograph's square, in units of its shorter side


def sample_object_scene(spec: DatasetSpec, split: Split, index: int, meshes: Meshes) -> Scene:
    """Draw the scene of one sample of a mesh, a pure function of the arguments; `meshes` are the specification's.

    A view of a box is drawn again until it shows enough of the object. Raises ValueError if none does.
    """
    if not spec.is_box:
        return _whole_scene(spec, split, index, meshes)
    for number in range(index, index + MOST_TRIES * AGAIN, AGAIN):
        scene = _whole_scene(spec, split, number, meshes)
        if view := view_of_box(scene, spec, stream_of(spec, split, number, Purpose.BOX), meshes):
            return view
    raise ValueError("no image of data.camera shows the object; check data.z_range, data.mesh and data.unit")


def _whole_scene(spec: DatasetSpec, split: Split, index: int, meshes: Meshes) -> Scene:
    """The scene in the frame of the camera.

    It is paired with that of `sample_scene`: the pose, the lamps and the panel are the cylinder's.
    """
    mesh, number = meshes["mesh"], index // spec.views
    scene = sample_scene(spec, split, index, mesh.radius * spec.scale_range[1])
    cylinder, *panel = scene.objects
    around, turn = surroundings_of(spec, split, number)
    item = cylinder.model_copy(update={"shape": "mesh", "dimensions": mesh.dimensions})
    if spec.front:
        rotation = _facing_rotation(spec, cylinder.position, stream_of(spec, split, number, Purpose.FRONT))
        item = item.model_copy(update={"rotation": rotation})
    item, upwards = _lying(spec, item, around, turn, mesh, stream_of(spec, split, number, Purpose.RESTING))
    if spec.ground:  # which the object touches
        around = around.model_copy(update={"ground": tuple(_foot(item, upwards, mesh).tolist())})
    others = [_resized(other, cylinder.position, mesh.radius / REACH) for other in panel]
    others += _distractors(spec, split, number, scene, meshes)
    lamps = () if around.is_sky else scene.lamps
    whole = scene.model_copy(update={"objects": (item, *others), "surroundings": around, "lamps": lamps})
    if spec.looks == "varied":
        whole = varied(whole, spec, stream_of(spec, split, number, Purpose.LOOKS))
    streams = (stream_of(spec, split, number, Purpose.COPIES, place) for place in range(spec.copies))
    copies = [_copy(spec, whole.objects[0], upwards, around, mesh, rng) for rng in streams]
    return whole.model_copy(update={"objects": (*whole.objects, *filter(None, copies))})


def _lying(
    spec: DatasetSpec, item: SceneObject, around: Surroundings, turn: float, mesh: Triangles, rng: Stream
) -> tuple[SceneObject, Array]:
    """An object as it lies, if it is upright or resting, and the direction upwards in its local frame."""
    rotation, upwards = item.rotation, np.array([0.0, 0.0, 1.0])
    if spec.upright or spec.resting:
        rotation = upright_rotation(around.pitch, turn)
    if spec.resting:
        onto_side = resting_turn(mesh, rng)
        rotation = quaternion_of(rotation_of(rotation) * onto_side)
        upwards = product(upwards, onto_side.as_matrix())
    return item.model_copy(update={"rotation": rotation}), upwards


def _foot(item: SceneObject, upwards: Array, mesh: Triangles) -> Array:
    """The point below the reference point of an object that is as low as its lowest point, scene frame."""
    up = item.scale * product(rotation_matrix(item.rotation), upwards)
    return np.array(item.position) + product(mesh.vertices, upwards).min() * up


def _copy(
    spec: DatasetSpec, item: SceneObject, upwards: Array, around: Surroundings, mesh: Triangles, rng: Stream
) -> SceneObject | None:
    """A further object like the first one, beside it, on the same plane if it lies; None behind the camera.

    A plane separates the two, so that they never run into each other.
    """
    free = item.model_copy(update={"rotation": uniform_rotation(rng)})
    other, others_upwards = _lying(spec, free, around, rng.uniform(0, math.tau), mesh, rng)
    direction = rng.normal(size=3)
    up, lies = product(rotation_matrix(item.rotation), upwards), spec.upright or spec.resting
    direction = unit(direction - lies * product(direction, up) * up)
    shift = rng.uniform(*BESIDE) * (_extent(item, direction, mesh) + _extent(other, -direction, mesh)) * direction
    if lies:
        shift += product(_foot(item, upwards, mesh) - _foot(other, others_upwards, mesh), up) * up
    x, y, z = (np.array(item.position) + shift).tolist()
    return other.model_copy(update={"position": (x, y, z)}) if z > item.scale * mesh.radius else None


def _extent(item: SceneObject, direction: Array, mesh: Triangles) -> float:
    """How far an object reaches from its reference point along a unit vector of the scene's frame, m."""
    local = product(direction, rotation_matrix(item.rotation))
    return float(item.scale * product(mesh.vertices, local).max())


def surroundings_of(spec: DatasetSpec, split: Split, number: int) -> tuple[Surroundings, float]:
    """The world around an object, without its ground, and a turn about the vertical, radians."""
    rng = stream_of(spec, split, number, Purpose.SURROUNDINGS)
    pitch, object_turn = math.radians(rng.uniform(*spec.pitch_range)), rng.uniform(0, math.tau)
    direction, path = rng.uniform(0, math.tau), rng.uniform(0, spec.motion_blur)
    files = spec.backdrop_files(split)
    file = files[rng.integers(len(files))] if files else None
    around = Surroundings(
        pitch=pitch,
        file=file,
        is_sky=file is not None and not file.lower().endswith(PHOTOS),
        turn=rng.uniform(0, math.tau),
        brightness=rng.uniform(*BRIGHTNESS),
        square=(rng.random(), rng.random(), rng.uniform(LEAST_SIDE, 1)),
        flipped=bool(rng.random() < 0.5),
        ground=None,
        shake=(path * math.cos(direction), path * math.sin(direction)),
        span=LARGEST_SPAN ** rng.random(),
    )
    return around, object_turn


def _facing_rotation(spec: DatasetSpec, position: Vector, rng: np.random.Generator) -> Quaternion:
    """A uniform rotation of an object, among those whose front has an angle of `front_range` to the camera."""
    assert spec.mesh is not None
    assert spec.front is not None
    front, z = in_blenders_axes(spec.front, next(iter(spec.mesh.files))), (0, 0, 1)
    farthest, nearest = np.cos(np.radians(spec.front_range))[::-1]
    around, spin = rng.uniform(0, math.tau, 2)
    tilt = Rotation.from_euler("ZYZ", [around, math.acos(rng.uniform(farthest, nearest)), spin])
    to_camera = Rotation.align_vectors([-np.array(position)], [z])[0]
    return quaternion_of(to_camera * tilt * Rotation.align_vectors([z], [front])[0])


def upright_rotation(pitch: float, turn: float) -> Quaternion:
    """Unit quaternion of a turn about the local z axis, which points up for a camera that looks down by `pitch`."""
    tilt = math.pi / 2 + pitch
    c, s, cos, sin = math.cos(tilt / 2), math.sin(tilt / 2), math.cos(turn / 2), math.sin(turn / 2)
    return c * cos, s * cos, -s * sin, c * sin


def _distractors(spec: DatasetSpec, split: Split, number: int, scene: Scene, meshes: Meshes) -> list[SceneObject]:
    """Random ones of the three solids and of the further meshes, each at most once: anywhere in the image, or near
    the object of a box.

    The bounding boxes of the solids have the surface of the object's. A panel replaces the cube.
    """
    names = [*SHAPES, *(name for name in meshes if name != "mesh")]
    anywhere = spec.model_copy(update={"xy_range": 1.0})
    a, b, c = meshes["mesh"].dimensions
    side = math.sqrt((a * b + b * c + c * a) / 3)
    first, *panel = scene.objects
    items, order = [], stream_of(spec, split, number, Purpose.DISTRACTORS).permutation(len(names))
    for place in order[: spec.distractors].tolist():
        rng = stream_of(spec, split, number, Purpose.DISTRACTORS, place)
        item = draw_object(anywhere, names[place], scene.f, rng, rng, rng)
        changes: dict[str, Any] = {
            "dimensions": meshes[item.shape].dimensions if item.shape in meshes else (side,) * 3
        }
        if spec.looks == "varied" and item.shape in SHAPES:  # rods, slabs and discs
            changes["dimensions"] = tuple(side * math.exp(log) for log in rng.uniform(*STRETCH, 3))
        if spec.is_box:
            changes["position"] = beside(first, first.scale * meshes["mesh"].radius, spec, rng)
        items.append(item.model_copy(update=changes))
    hidden = {item.shape for item in panel}
    return [item for item in items if item.shape not in hidden and item.position[2] > 0]


def _resized(panel: SceneObject, hidden: Vector, ratio: float) -> SceneObject:
    """A panel for an object `ratio` times as large as the cylinder: its edge stays on the line of sight."""
    edge = panel.position[2] / hidden[2] * np.array(hidden)
    position = tuple((edge + ratio * (np.array(panel.position) - edge)).tolist())
    return panel.model_copy(update={"position": position, "dimensions": tuple(ratio * s for s in panel.dimensions)})
