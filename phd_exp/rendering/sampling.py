"""From (specification, split, index) to a scene: numpy alone, no state, no order."""

import colorsys
import math
from enum import IntEnum

import numpy as np

from phd_exp.records.scenes import (
    FIRST_VIEW,
    Backdrop,
    Lamp,
    LampName,
    Material,
    Pose,
    Scene,
    SceneObject,
    Shape,
    Split,
)
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rotations import about_axis, rotation_matrix, uniform_rotation

# Raised whenever the same specification starts to give other scenes or other pixels: folders made by
# another generation are then refused instead of being continued with samples of another kind.
GENERATOR_VERSION = 2

SPLIT_NUMBER: dict[Split, int] = {"train": 0, "test": 1}
SIZE = 0.2  # m: height and diameter of the cylinder, side of the cube, diameter of the sphere
CLEARANCE = 0.5  # m from a further view's camera to every object: none is inside another's lens
MOST_TRIES = 10_000


class Purpose(IntEnum):
    """One random stream for each purpose, so that variants are paired: what one adds shifts nothing else.

    The numbers are part of every data set; append, never renumber.
    """

    CAMERA = 0
    LAMPS = 1
    BACKDROP = 2
    NOISE = 3
    CYLINDER_POSE = 10
    CYLINDER_LOOK = 11
    CYLINDER_SCALE = 12
    CUBE_POSE = 20
    CUBE_LOOK = 21
    CUBE_SCALE = 22
    SPHERE_POSE = 30
    SPHERE_LOOK = 31
    SPHERE_SCALE = 32
    VIEW = 40  # followed by the view's number


STREAMS: dict[Shape, tuple[Purpose, Purpose, Purpose]] = {
    "cylinder": (Purpose.CYLINDER_POSE, Purpose.CYLINDER_LOOK, Purpose.CYLINDER_SCALE),
    "cube": (Purpose.CUBE_POSE, Purpose.CUBE_LOOK, Purpose.CUBE_SCALE),
    "sphere": (Purpose.SPHERE_POSE, Purpose.SPHERE_LOOK, Purpose.SPHERE_SCALE),
}

# (name, direction from the middle of the scene, side in m, power in W). They stand far away: across two
# metres of depth a lamp's light changes by less than its jitter, so that brightness does not give depth away.
LAMP_DISTANCE = 20.0
LAMPS: tuple[tuple[LampName, tuple[float, float, float], float, float], ...] = (
    ("key", (-0.62, -0.62, -0.48), 7.0, 4200.0),
    ("fill", (0.80, -0.20, -0.56), 9.0, 1300.0),
    ("back", (0.42, -0.66, 0.62), 6.0, 3000.0),
)


def scene_and_view(spec: DatasetSpec, index: int) -> tuple[int, int]:
    """Which scene of its split a sample shows, and which view of it."""
    return divmod(index, spec.views)


def sample_scene(spec: DatasetSpec, split: Split, index: int) -> Scene:
    """Draw what one sample shows: a pure function of the three arguments.

    Source: paper, section "Dataset"; lamps after CLEVR (key, fill and back area lamps with jitter).
    """
    number, view = scene_and_view(spec, index)

    def stream(purpose: Purpose) -> np.random.Generator:
        return _stream(spec, split, number, purpose)

    f = _uniform(stream(Purpose.CAMERA), spec.f_range)
    shapes: tuple[Shape, ...] = ("cylinder", "cube", "sphere") if spec.occluders else ("cylinder",)
    objects = []
    for shape in shapes:
        pose, look, size = (stream(purpose) for purpose in STREAMS[shape])
        objects.append(_object(spec, shape, f, pose, look, size))
    scene = Scene(
        f=f,
        S=spec.sensor_size,
        pose=FIRST_VIEW,
        objects=tuple(objects),
        lamps=_lamps(spec, stream(Purpose.LAMPS)),
        backdrop=_backdrop(stream(Purpose.BACKDROP)),
        noise_seed=_seed(stream(Purpose.NOISE)),
    )
    return _seen_again(scene, spec, _stream(spec, split, number, Purpose.VIEW, view)) if view else scene


def _stream(spec: DatasetSpec, split: Split, scene: int, *purpose: int) -> np.random.Generator:
    key = (SPLIT_NUMBER[split], scene, *(int(part) for part in purpose))
    return np.random.default_rng(np.random.SeedSequence(entropy=spec.seed, spawn_key=key))


def _seen_again(scene: Scene, spec: DatasetSpec, rng: np.random.Generator) -> Scene:
    """The same scene before another camera, turned about an axis across the first one's line of sight.

    Its focal length and the cylinder's place before it follow the law of the first view, and as the cylinder's
    rotation is uniform, it is so before every camera. The lamps stand where they stood.
    """
    f = _uniform(rng, spec.f_range)
    return scene.model_copy(
        update={
            "f": f,
            "pose": _pose(scene.objects, spec, f, rng),
            "backdrop": _backdrop(rng),
            "noise_seed": _seed(rng),
        }
    )


def _pose(objects: tuple[SceneObject, ...], spec: DatasetSpec, f: float, rng: np.random.Generator) -> Pose:
    """A camera with all objects in front of it."""
    places = np.array([item.position for item in objects])
    for _ in range(MOST_TRIES):
        direction = _uniform(rng, (0.0, math.tau))
        angle = math.radians(_uniform(rng, spec.view_angle_range))
        rotation = about_axis((math.cos(direction), math.sin(direction), 0.0), angle)
        matrix = rotation_matrix(rotation)
        shift = np.array(_position(spec, f, rng)) - matrix @ places[0]
        if (places @ matrix.T + shift)[:, 2].min() >= CLEARANCE:
            x, y, z = shift.tolist()
            return Pose(rotation=rotation, translation=(x, y, z))
    raise ValueError(f"no camera sees all {len(objects)} objects: lower view_angle_range")


def _object(
    spec: DatasetSpec,
    shape: Shape,
    f: float,
    pose: np.random.Generator,
    look: np.random.Generator,
    size: np.random.Generator,
) -> SceneObject:
    return SceneObject(
        shape=shape,
        position=_position(spec, f, pose),
        rotation=uniform_rotation(pose),
        dimensions=(SIZE, SIZE, SIZE),
        scale=_uniform(size, spec.scale_range),
        colour=_colour(look),
        material=_material(look),
    )


def _position(spec: DatasetSpec, f: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """A place before a camera; z first, since x and y are spread over the field of view at that depth."""
    z = _uniform(rng, spec.z_range)
    half_width = 0.5 * spec.xy_range * spec.sensor_size * z / f
    x, y = (_uniform(rng, (-half_width, half_width)) for _ in range(2))
    return x, y, z


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """sRGB of any hue, neither so grey as to merge with the backdrop nor so dark that shading is lost."""
    hue, saturation, value = rng.random(), _uniform(rng, (0.45, 0.95)), _uniform(rng, (0.45, 0.95))
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, value)
    return r, g, b


def _material(rng: np.random.Generator) -> Material:
    return "metal" if rng.random() < 0.5 else "rubber"


def _lamps(spec: DatasetSpec, rng: np.random.Generator) -> tuple[Lamp, ...]:
    """The three lamps about the middle of the scene, each moved and dimmed or brightened by the jitter."""
    middle = (0.0, 0.0, sum(spec.z_range) / 2)
    jitter = (-spec.lamp_jitter, spec.lamp_jitter)
    lamps = []
    for name, direction, side, power in LAMPS:
        shift = np.array([_uniform(rng, jitter) for _ in range(3)])
        x, y, z = (np.array(middle) + LAMP_DISTANCE * (np.array(direction) + shift)).tolist()
        power = power * (1 + _uniform(rng, jitter))
        lamps.append(Lamp(name=name, position=(x, y, z), towards=middle, side=side, power=power))
    return tuple(lamps)


def _backdrop(rng: np.random.Generator) -> Backdrop:
    """Brightest about the upper middle of the image, as under a studio lamp."""
    centre = (_uniform(rng, (0.25, 0.75)), _uniform(rng, (0.0, 0.5)))
    return Backdrop(level=_uniform(rng, (0.52, 0.68)), falloff=_uniform(rng, (0.15, 0.45)), centre=centre)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def _uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return bounds[0] + (bounds[1] - bounds[0]) * rng.random()
