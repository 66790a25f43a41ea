"""Scenes of the user's mesh: those of the cylinder, with the mesh in its place and the world around it."""

import math
from typing import Any

import numpy as np

from phd_exp.records.assets import SKIES, Asset
from phd_exp.records.scenes import Photo, Quaternion, Scene, SceneObject, Sky, Split, Surroundings, Vector
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.sampling import (
    SHAPES,
    SIZE,
    Purpose,
    Stream,
    draw_object,
    sample_scene,
    scene_and_view,
    stream_of,
)  # fmt: skip
from phd_exp.rendering.triangles import Meshes, Triangles

REACH = SIZE * 0.5**0.5  # m, from the cylinder's centre to its rim
BRIGHTNESS = (0.25, 1.0)  # mean radiance of a sky
LEAST_SIDE = 0.4  # of a photograph's square, in units of its shorter side


def sample_object_scene(spec: DatasetSpec, split: Split, index: int, meshes: Meshes) -> Scene:
    """Draw the scene of one sample of a mesh, a pure function of the arguments; `meshes` are the specification's.

    All draws that cylinders need are those of `sample_scene`, so that data sets of objects are paired with them.
    """
    scene, (number, _) = sample_scene(spec, split, index), scene_and_view(spec, index)
    cylinder, *panel = scene.objects
    rng = stream_of(spec, split, number, Purpose.SURROUNDINGS)
    pitch, turn = math.radians(rng.uniform(*spec.pitch_range)), rng.uniform(0, math.tau)
    direction, shake = rng.uniform(0, math.tau), rng.uniform(0, spec.motion_blur)
    rotation = upright_rotation(pitch, turn) if spec.upright else cylinder.rotation
    changes: dict[str, Any] = {"shape": "mesh", "dimensions": meshes["mesh"].dimensions, "rotation": rotation}
    item, background = cylinder.model_copy(update=changes), _background(spec, split, rng)
    surroundings = Surroundings(
        pitch=pitch,
        background=background,
        ground=_below(item, meshes["mesh"]) if spec.ground else None,
        shake=(shake * math.cos(direction), shake * math.sin(direction)),
    )
    ratio = meshes["mesh"].radius / REACH
    shapes = [other.shape for other in panel]
    others = [other for other in _distractors(spec, split, number, scene.f, meshes) if other.shape not in shapes]
    others += [_resized(other, cylinder.position, ratio) for other in panel]
    update = {"objects": (item, *others), "surroundings": surroundings}
    return scene.model_copy(update=update | ({"lamps": ()} if isinstance(background, Sky) else {}))


def upright_rotation(pitch: float, turn: float) -> Quaternion:
    """Unit quaternion that turns the local z axis up, for a camera that looks down by `pitch`, after a turn about it."""
    tilt = math.pi / 2 + pitch
    c, s, cos, sin = math.cos(tilt / 2), math.sin(tilt / 2), math.cos(turn / 2), math.sin(turn / 2)
    return c * cos, s * cos, -s * sin, c * sin


def _below(item: SceneObject, mesh: Triangles) -> Vector:
    """The point of the ground below the reference point of an upright object, which touches the ground."""
    up = rotation_matrix(item.rotation)[:, 2]
    x, y, z = (np.array(item.position) + item.scale * mesh.vertices[:, 2].min() * up).tolist()
    return x, y, z


def _background(spec: DatasetSpec, split: Split, rng: Stream) -> Sky | Photo | None:
    if spec.backdrops is None:
        return None
    files = spec.backdrop_files(split)
    file = files[rng.integers(len(files))]
    if not isinstance(spec.backdrops, Asset) or file.lower().endswith(SKIES):
        return Sky(file=file, turn=rng.uniform(0, math.tau), brightness=rng.uniform(*BRIGHTNESS))
    place = (rng.random(), rng.random())
    return Photo(file=file, side=rng.uniform(LEAST_SIDE, 1), place=place, flipped=rng.random() < 0.5)


def _distractors(spec: DatasetSpec, split: Split, number: int, f: float, meshes: Meshes) -> list[SceneObject]:
    """Random ones of the three solids, as large as the object, and the further meshes, each at most once."""
    side = SIZE * meshes["mesh"].radius / REACH
    names = [*SHAPES, *(name for name in meshes if name != "mesh")]
    chosen = stream_of(spec, split, number, Purpose.DISTRACTORS).permutation(len(names))[: spec.distractors]
    items = []
    for place in chosen.tolist():
        rng = stream_of(spec, split, number, Purpose.DISTRACTORS, place)
        item = draw_object(spec, names[place], f, rng, rng, rng)
        own = meshes[item.shape].dimensions if item.shape in meshes else (side,) * 3
        items.append(item.model_copy(update={"dimensions": own}))
    return items


def _resized(panel: SceneObject, hidden: Vector, ratio: float) -> SceneObject:
    """A panel for an object `ratio` times as large as the cylinder: its edge stays on the line of sight."""
    edge = panel.position[2] / hidden[2] * np.array(hidden)
    x, y, z = (edge + ratio * (np.array(panel.position) - edge)).tolist()
    dimensions = tuple(ratio * side for side in panel.dimensions)
    return panel.model_copy(update={"position": (x, y, z), "dimensions": dimensions})
