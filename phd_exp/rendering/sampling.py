"""From (specification, split, index) to a scene: a pure function, equal to the bit on all processors."""

import colorsys
import math
from collections.abc import Callable
from enum import IntEnum, unique
from functools import partial
from typing import get_args

import numpy as np
from jaxtyping import Float

from phd_exp.optics.virtual import product, rays
from phd_exp.records.scenes import (
    FIRST_VIEW,
    SHAPES,
    Backdrop,
    Lamp,
    LampName,
    Pose,
    Quaternion,
    Scene,
    SceneObject,
    Split,
    Vector,
)  # fmt: skip
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import optics, rotation_matrix
from phd_exp.rendering.sequences import camera_pose, in_scene, moved, slid

# Increment one when the same specification starts to give other scenes or other pixels. Folders of another version
# are refused, not continued with samples that do not match.
GENERATOR_VERSION = 2
OBJECT_VERSION = 11  # of data sets with a mesh

SIZE = 0.2  # m: height and diameter of the cylinder, side of the cube, diameter of the sphere
CLEARANCE = 0.5  # m: least depth of an object in a further view, unless those of the first are smaller
MOST_TRIES = 10_000
PANEL = (0.2, 0.4, 0.02)  # m: wider than half of the largest silhouette at its depth
Stream = np.random.Generator


@unique
class Purpose(IntEnum):
    """One random stream per purpose, so that variants are paired: an addition to a variant changes nothing else.

    The numbers are part of every data set; append, never renumber.
    """

    CAMERA = 0
    LAMPS = 1
    BACKDROP = 2
    NOISE = 3
    OBJECT = 10  # plus 10 per shape, in the order of SHAPES; then POSE, LOOK or SCALE
    VIEW = 40  # followed by the view's number
    PANEL = 50
    SURROUNDINGS = 60
    DISTRACTORS = 70  # followed by the number of each
    BOX = 80
    FRONT = 81
    LOOKS = 82
    RESTING = 83
    COPIES = 84  # followed by the number of each
    MOTION = 90  # followed by the place of the shape
    CAMERA_MOTION = 91
    FRAME_NOISE = 92  # followed by the number of the frame, and of a further view
    VIEW_MOTION = 93  # followed by the view's number


POSE, LOOK, SCALE = range(3)

# (name, direction from the middle of the scene, side in m, power in W). The lamps are far away: across two metres of
# depth a lamp's light changes by less than its jitter, so that brightness does not reveal depth.
LAMP_DISTANCE = 20.0
LAMPS: tuple[tuple[LampName, tuple[float, float, float], float, float], ...] = (
    ("key", (-0.62, -0.62, -0.48), 7.0, 4200.0),
    ("fill", (0.80, -0.20, -0.56), 9.0, 1300.0),
    ("back", (0.42, -0.66, 0.62), 6.0, 3000.0),
)


def generator_version(spec: DatasetSpec) -> int:
    """The version of the scenes and pixels of a specification."""
    return GENERATOR_VERSION if spec.mesh is None else OBJECT_VERSION


def sample_scene(spec: DatasetSpec, split: Split, index: int, radius: float = 0.0) -> Scene:
    """Draw the scene of one sample, a pure function of the arguments.

    `radius` (m) is that of the object in views of boxes, where it shall rarely be cut off.

    Source: paper, section "Dataset"; lamps after CLEVR (key, fill and back area lamps with jitter).
    """
    number, view = divmod(index, spec.views)
    number, frame = divmod(number, spec.frames)
    stream = partial(stream_of, spec, split, number)
    f = _uniform(stream(Purpose.CAMERA), spec.f_range)
    scene = Scene(
        f=f,
        S=spec.sensor_size,
        pose=_first_pose(spec, frame, stream),
        objects=_objects(spec, f, frame, stream, radius),
        lamps=_lamps(spec, stream(Purpose.LAMPS)),
        backdrop=_backdrop(stream(Purpose.BACKDROP)),
        noise_seed=_seed(stream(Purpose.FRAME_NOISE, frame) if frame else stream(Purpose.NOISE)),
    )
    return _seen_again(scene, spec, frame, view, stream) if view else scene


def _first_pose(spec: DatasetSpec, frame: int, stream: Callable[..., Stream]) -> Pose:
    """The pose of the first camera in a frame of its sequence."""
    return camera_pose(spec, frame / spec.frame_rate, stream(Purpose.CAMERA_MOTION)) if frame else FIRST_VIEW


def _objects(
    spec: DatasetSpec, f: float, frame: int, stream: Callable[..., Stream], radius: float = 0.0
) -> tuple[SceneObject, ...]:
    """The objects in front of the first view, in a frame of its sequence."""
    objects, pose = [], _first_pose(spec, frame, stream)
    for place, shape in enumerate(SHAPES if spec.occluders else SHAPES[:1]):
        where, look, size = (stream(Purpose.OBJECT + 10 * place + part) for part in (POSE, LOOK, SCALE))
        item = draw_object(spec, shape, f, where, look, size, radius)
        if frame:
            item = moved(item, spec, f, frame / spec.frame_rate, stream(Purpose.MOTION, place))
        objects.append(item)
    panels = [_panel(spec, objects[0].position, f, stream(Purpose.PANEL))] if spec.half_hidden else []
    objects = [item for item in objects if not panels or item.shape != panels[0].shape]
    if frame:  # panels are parallel to the image, whatever the camera's pose
        objects = [in_scene(item, pose, turned=False) for item in objects]
        panels = [in_scene(item, pose, turned=True) for item in panels]
    return (*objects, *panels)


def about_axis(axis: Vector, angle: float) -> Quaternion:
    """Unit quaternion of a right-handed turn by `angle` (radians) about a unit vector."""
    x, y, z = (math.sin(angle / 2) * component for component in axis)
    return math.cos(angle / 2), x, y, z


def uniform_rotation(rng: Stream) -> Quaternion:
    """Unit quaternion of a random rotation with the uniform distribution (the Haar measure of SO(3)).

    Source: K. Shoemake, "Uniform random rotations", Graphics Gems III (1992).
    """
    u, first, second = rng.random(3).tolist()
    a, b = math.sqrt(1 - u), math.sqrt(u)
    return (
        b * math.cos(math.tau * second),
        a * math.sin(math.tau * first),
        a * math.cos(math.tau * first),
        b * math.sin(math.tau * second),
    )


def stream_of(spec: DatasetSpec, split: Split, scene: int, *purpose: int) -> Stream:
    """The random numbers for a purpose, the same whatever else is drawn."""
    key = (get_args(Split).index(split), scene, *map(int, purpose))
    return np.random.default_rng(np.random.SeedSequence(entropy=spec.seed, spawn_key=key))


def _seen_again(scene: Scene, spec: DatasetSpec, frame: int, view: int, stream: Callable[..., Stream]) -> Scene:
    """The same scene in front of another camera, turned about an axis orthogonal to the first one's line of sight.

    The focal length and the cylinder's position in the camera frame have the distribution of the first view. The
    cylinder's rotation is uniform in every camera frame, because it is so in one. The lamps do not move.
    """
    rng = stream(Purpose.VIEW, view)
    f = _uniform(rng, spec.f_range)
    places = [[item.position for item in _objects(spec, scene.f, k, stream)] for k in range(spec.frames)]
    pose = _poses(np.array(places), spec, f, rng, partial(stream, Purpose.VIEW_MOTION, view))[frame]
    changes = {"f": f, "pose": pose, "backdrop": _backdrop(rng), "noise_seed": _seed(rng)}
    if frame:
        changes["noise_seed"] = _seed(stream(Purpose.FRAME_NOISE, frame, view))
    return scene.model_copy(update=changes)


def _poses(
    places: Float[np.ndarray, "frames objects 3"],
    spec: DatasetSpec,
    f: float,
    rng: Stream,
    motion: Callable[[], Stream],
) -> list[Pose]:
    """The poses, in all frames, of a further camera that has all objects in front of it in each of them."""
    times = [frame / spec.frame_rate for frame in range(1, spec.frames)]
    for _ in range(MOST_TRIES):
        direction = _uniform(rng, (0.0, math.tau))
        angle = math.radians(_uniform(rng, spec.view_angle_range))
        rotation = about_axis((math.cos(direction), math.sin(direction), 0.0), angle)
        matrix = rotation_matrix(rotation)
        first = _position(spec, f, rng)
        seen = [first, *(slid(first, spec, f, time, motion()) for time in times)]
        turned = product(places, matrix.T)
        shifts = np.array(seen) - turned[:, 0]
        if (turned + shifts[:, None])[..., 2].min() >= min(CLEARANCE, spec.z_range[0]):
            return [Pose(rotation=rotation, translation=(x, y, z)) for x, y, z in shifts.tolist()]
    raise ValueError(f"no camera sees all {places.shape[1]} objects: lower view_angle_range")


def draw_object(
    spec: DatasetSpec, shape: str, f: float, pose: Stream, look: Stream, size: Stream, radius: float = 0.0
) -> SceneObject:
    """An object as large as the cylinder, whose pose, look and scale come from three streams."""
    return SceneObject(
        shape=shape,
        position=_position(spec, f, pose, radius),
        rotation=uniform_rotation(pose),
        dimensions=(SIZE, SIZE, SIZE),
        scale=_uniform(size, spec.scale_range),
        colour=_colour(spec, look),
        material="metal" if look.random() < 0.5 else "rubber",
    )


def _panel(spec: DatasetSpec, hidden: Vector, f: float, rng: Stream) -> SceneObject:
    """A panel parallel to the image, with an edge through the line of sight to the centre of the hidden object.

    A convex object that is symmetric about its centre has a symmetric silhouette, up to perspective: the edge halves
    it.
    """
    panel = draw_object(spec, "cube", f, rng, rng, rng)
    angle, depth = _uniform(rng, (0.0, math.tau)), _uniform(rng, (0.6, 0.8))
    x, y, z = (depth * coordinate for coordinate in hidden)
    middle = (x + 0.5 * PANEL[0] * math.cos(angle), y + 0.5 * PANEL[0] * math.sin(angle), z)
    changes = {"position": middle, "rotation": about_axis((0.0, 0.0, 1.0), angle), "dimensions": PANEL, "scale": 1.0}
    return panel.model_copy(update=changes)


def _position(spec: DatasetSpec, f: float, rng: Stream, radius: float = 0.0) -> tuple[float, float, float]:
    """A position in the camera frame; z is drawn first, because x and y span the field of view at that depth."""
    z = _uniform(rng, spec.z_range)
    if spec.is_box:
        return _in_image(spec, z, rng, radius)
    half_width = 0.5 * spec.xy_range * spec.sensor_size * z / f
    x, y = (_uniform(rng, (-half_width, half_width)) for _ in range(2))
    return x, y, z


def _in_image(spec: DatasetSpec, z: float, rng: Stream, radius: float) -> tuple[float, float, float]:
    """A position at depth z whose pixel is uniform in a part of the user's image.

    The edges of the image are edge_distance times the radius (m) of the object outside this part, of which xy_range
    is the central share.
    """
    assert spec.camera is not None
    K, lens = optics(spec.camera)
    size = np.array([spec.camera.width, spec.camera.height], dtype=float)
    room = spec.xy_range * (size - 2 * spec.edge_distance * spec.camera.K[0] * radius / z).clip(0)
    for _ in range(MOST_TRIES):
        x, y, ahead = rays(K, size / 2 + room * (rng.random(2) - 0.5), lens).tolist()
        if ahead > 0:  # not where a fisheye shows nothing, or what is behind
            return x / ahead * z, y / ahead * z, z
    raise ValueError("data.camera shows nothing in front of it; check its coefficients")


def _colour(spec: DatasetSpec, rng: Stream) -> tuple[float, float, float]:
    """sRGB of any hue; by default not too grey, which would merge with the backdrop; not too dark to show shading."""
    hue, saturation, value = rng.random(), _uniform(rng, spec.saturation_range), _uniform(rng, (0.45, 0.95))
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, value)
    return r, g, b


def _lamps(spec: DatasetSpec, rng: Stream) -> tuple[Lamp, ...]:
    """The three lamps around the middle of the scene, with jitter in place and power."""
    middle, far = (0.0, 0.0, sum(spec.z_range) / 2), remoteness(spec)
    jitter = (-spec.lamp_jitter, spec.lamp_jitter)
    lamps = []
    for name, direction, side, power in LAMPS:
        shift = np.array([_uniform(rng, jitter) for _ in range(3)])
        x, y, z = (np.array(middle) + far * LAMP_DISTANCE * (np.array(direction) + shift)).tolist()
        power = far**2 * power * (1 + _uniform(rng, jitter))
        lamps.append(Lamp(name=name, position=(x, y, z), towards=middle, side=far * side, power=power))
    return tuple(lamps)


def remoteness(spec: DatasetSpec) -> float:
    """Factor of the distances of lamps and the sizes of surroundings: more than 1 for objects beyond 100 m."""
    return max(1.0, spec.z_range[1] / 100)


def _backdrop(rng: Stream) -> Backdrop:
    """Brightest near the upper middle of the image, as under a studio lamp."""
    centre = (_uniform(rng, (0.25, 0.75)), _uniform(rng, (0.0, 0.5)))
    return Backdrop(level=_uniform(rng, (0.52, 0.68)), falloff=_uniform(rng, (0.15, 0.45)), centre=centre)


def _seed(rng: Stream) -> int:
    return int(rng.integers(2**31))


def _uniform(rng: Stream, bounds: tuple[float, float]) -> float:
    return bounds[0] + (bounds[1] - bounds[0]) * rng.random()
