"""From (specification, split, index) to a scene: numpy alone, no state, no order."""

import colorsys
import math
from enum import IntEnum

import numpy as np

from phd_exp.records.scenes import Backdrop, Lamp, LampName, Material, Scene, SceneObject, Shape, Split
from phd_exp.records.spec import DatasetSpec

# Raised whenever the same specification starts to give other scenes or other pixels: folders made by
# another generation are then refused instead of being continued with samples of another kind.
GENERATOR_VERSION = 1

SPLIT_NUMBER: dict[Split, int] = {"train": 0, "test": 1}
SIZE = 0.2  # m: height and diameter of the cylinder, side of the cube, diameter of the sphere


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


def sample_scene(spec: DatasetSpec, split: Split, index: int) -> Scene:
    """Draw one scene: a pure function of the three arguments.

    Source: paper, section "Dataset"; lamps after CLEVR (key, fill and back area lamps with jitter).
    """

    def stream(purpose: Purpose) -> np.random.Generator:
        key = (SPLIT_NUMBER[split], index, int(purpose))
        return np.random.default_rng(np.random.SeedSequence(entropy=spec.seed, spawn_key=key))

    f = _uniform(stream(Purpose.CAMERA), spec.f_range)
    shapes: tuple[Shape, ...] = ("cylinder", "cube", "sphere") if spec.occluders else ("cylinder",)
    objects = []
    for shape in shapes:
        pose, look, size = (stream(purpose) for purpose in STREAMS[shape])
        objects.append(_object(spec, shape, f, pose, look, size))
    return Scene(
        f=f,
        S=spec.sensor_size,
        objects=tuple(objects),
        lamps=_lamps(spec, stream(Purpose.LAMPS)),
        backdrop=_backdrop(stream(Purpose.BACKDROP)),
        noise_seed=int(stream(Purpose.NOISE).integers(2**31)),
    )


def _object(
    spec: DatasetSpec,
    shape: Shape,
    f: float,
    pose: np.random.Generator,
    look: np.random.Generator,
    size: np.random.Generator,
) -> SceneObject:
    """One object; z first, since x and y are spread over the field of view at that depth."""
    z = _uniform(pose, spec.z_range)
    half_width = 0.5 * spec.xy_range * spec.sensor_size * z / f
    x, y = (_uniform(pose, (-half_width, half_width)) for _ in range(2))
    return SceneObject(
        shape=shape,
        position=(x, y, z),
        rotation=uniform_rotation(pose),
        dimensions=(SIZE, SIZE, SIZE),
        scale=_uniform(size, spec.scale_range),
        colour=_colour(look),
        material=_material(look),
    )


def uniform_rotation(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """A unit quaternion (w, x, y, z), uniform over the rotations (the Haar measure of SO(3)).

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


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    """sRGB of any hue, neither so grey as to merge with the backdrop nor so dark that shading is lost."""
    hue, saturation, value = rng.random(), _uniform(rng, (0.45, 0.95)), _uniform(rng, (0.45, 0.95))
    r, g, b = colorsys.hsv_to_rgb(hue, saturation, value)
    return r, g, b


def _material(rng: np.random.Generator) -> Material:
    return "metal" if rng.random() < 0.5 else "rubber"


def _lamps(spec: DatasetSpec, rng: np.random.Generator) -> tuple[Lamp, ...]:
    """The three lamps about the middle of the scene, each moved and dimmed or brightened by the jitter."""
    middle = np.array([0.0, 0.0, sum(spec.z_range) / 2])
    jitter = (-spec.lamp_jitter, spec.lamp_jitter)
    lamps = []
    for name, direction, side, power in LAMPS:
        shift = np.array([_uniform(rng, jitter) for _ in range(3)])
        x, y, z = (middle + LAMP_DISTANCE * (np.array(direction) + shift)).tolist()
        brightness = 1 + _uniform(rng, jitter)
        lamps.append(Lamp(name=name, position=(x, y, z), side=side, power=power * brightness))
    return tuple(lamps)


def _backdrop(rng: np.random.Generator) -> Backdrop:
    """Brightest about the upper middle of the image, as under a studio lamp."""
    centre = (_uniform(rng, (0.25, 0.75)), _uniform(rng, (0.0, 0.5)))
    return Backdrop(level=_uniform(rng, (0.52, 0.68)), falloff=_uniform(rng, (0.15, 0.45)), centre=centre)


def _uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return bounds[0] + (bounds[1] - bounds[0]) * rng.random()
