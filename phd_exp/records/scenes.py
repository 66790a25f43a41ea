"""A scene as data, and a line of `metadata.jsonl`, which describes an image.

Camera frame: x right, y down, z forward, metres. A scene's own frame is the camera frame of its first view. An
object's local frame has its origin at the object's centre; a cylinder's axis is the local z axis. That of a mesh has
its origin at the reference point and Blender's axes, z up: (x, -z, y) of glTF and OBJ, (x, y, z) of PLY and STL.
"""

import math
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field

from phd_exp.records.cameras import Calibration
from phd_exp.records.parsing import Record

Split = Literal["train", "test"]
Shape = Literal["cylinder", "cube", "sphere"]
SHAPES: tuple[Shape, ...] = get_args(Shape)
MeshName = Annotated[str, Field(pattern=r"^mesh[0-9]*$")]  # `mesh` is the user's object, the others are distractors
Material = Literal["rubber", "metal"]
Pattern = Literal["plain", "noise", "checker", "scratches"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
LampName = Literal["key", "fill", "back"]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[Finite, Finite, Finite]
Place = Annotated[float, Field(ge=-1e9, le=1e9)]  # m; in larger worlds, float64 is too coarse
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0)]


def _unit(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > 1e-6:
        raise ValueError(f"a rotation is a unit quaternion, this one has norm {norm:.6g}")
    return quaternion


Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_unit)]


class Look(Record):
    """A random surface, of looks=varied.

    Attributes:
        pattern, cells, second: of an object without materials: a pattern of its colour and a second one, sRGB, with
            about so many cells along its longest side.
        roughness, metallic: of the same, as in Blender's Principled BSDF.
        hue, saturation, value: of an object's own materials: turns added to the hue, and factors.
    """

    pattern: Pattern
    cells: Positive
    second: tuple[Share, Share, Share]
    roughness: Share
    metallic: Share
    hue: Finite
    saturation: Positive
    value: Positive


class SceneObject(Record):
    """One rigid object.

    Attributes:
        position: centre, scene frame, m.
        rotation: unit quaternion (w, x, y, z) from local axes to the scene's.
        dimensions: extent along the local axes at scale 1, m.
        scale: factor on all three dimensions.
        colour: sRGB; as the material, of a mesh without its own.
        look: replaces the material, of looks=varied.
    """

    shape: Shape | MeshName
    position: Vector
    rotation: Quaternion
    dimensions: tuple[Positive, Positive, Positive]
    scale: Positive
    colour: tuple[Share, Share, Share]
    material: Material
    look: Annotated[Look | None, Field(exclude_if=lambda value: value is None)] = None


class Lamp(Record):
    """A square area lamp: its position and the point that it faces (scene frame, m), side (m), power (W)."""

    name: LampName
    position: Vector
    towards: Vector
    side: Positive
    power: Positive


class Backdrop(Record):
    """The light-grey background: linear brightness level (1 - falloff |p - centre|^2).

    p is the place in the image in units of its side, x right and y down from the top left corner. The backdrop
    depends on the pixel alone and therefore reveals neither depth nor focal length.
    """

    level: Share
    falloff: Share
    centre: tuple[Finite, Finite]


class Surroundings(Record):
    """The world around a mesh.

    Attributes:
        pitch: angle by which the first camera looks down, radians.
        file: a sky, which also lights the scene, or a photograph; None: the backdrop.
        turn: of a sky about the vertical, radians.
        brightness: factor of a sky's light.
        square: of a photograph: shares of the free space on the left and above, side in units of the shorter side.
        flipped: whether the photograph's left and right are exchanged.
        ground: a point of the plane on which the object stands, scene frame, m.
        shake: path of the image during the exposure, right and down, px.
        span: factor of the field of view in which the camera shows a sky; its light comes from the true directions.
    """

    pitch: Finite
    file: str | None
    is_sky: bool
    turn: Finite
    brightness: Positive
    square: tuple[Share, Share, Share]
    flipped: bool
    ground: Vector | None
    shake: tuple[Finite, Finite]
    span: Positive


class Pose(Record):
    """Pose of a camera, the map from the scene's frame to the camera's: p_camera = R p_scene + translation.

    Attributes:
        rotation: unit quaternion (w, x, y, z) of R.
        translation: m.
    """

    rotation: Quaternion
    translation: tuple[Place, Place, Place]


FIRST_VIEW = Pose(rotation=(1.0, 0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0))


def _one_of_each(objects: tuple[SceneObject, ...]) -> tuple[SceneObject, ...]:
    shapes = [item.shape for item in objects]
    others = [shape for shape in shapes if shape != "mesh" or shapes[0] != "mesh"]  # a mesh may have copies
    if shapes[0] not in ("cylinder", "mesh") or len(set(others)) < len(others):
        raise ValueError(f"a scene is a cylinder or mesh first, then other shapes, each once; these are {shapes}")
    return objects


# not written where there is none: records of cylinders stay as they were
OfMesh = Annotated[Surroundings | None, Field(exclude_if=lambda value: value is None)]
OfBox = Annotated[Calibration | None, Field(exclude_if=lambda value: value is None)]
Box = Annotated[tuple[Finite, Finite, Finite, Finite] | None, Field(exclude_if=lambda value: value is None)]
OfSequence = Annotated[Finite | None, Field(exclude_if=lambda value: value is None)]
Track = Annotated[str | None, Field(exclude_if=lambda value: value is None)]
Objects = Annotated[tuple[SceneObject, ...], Field(min_length=1), AfterValidator(_one_of_each)]


class Scene(Record):
    """The renderer's input for one image.

    Attributes:
        f: focal length, px; the principal point is the middle of the image.
        S: side of the square image, px.
        pose: pose of the camera.
        objects: the cylinder or mesh first.
        noise_seed: seed of the path tracer.
        surroundings: of a mesh.
        real_camera, real_box: of a view of a box: the user's camera, whose frame is the scene's, and the box in its
            image, px: left, top, right, bottom.
    """

    f: Positive
    S: Annotated[int, Field(gt=0)]
    pose: Pose
    objects: Objects
    lamps: tuple[Lamp, ...]
    backdrop: Backdrop
    noise_seed: Seed
    surroundings: OfMesh = None
    real_camera: OfBox = None
    real_box: Box = None


class SampleRecord(Record):
    """One line of `metadata.jsonl`: the image's name, the network's targets, and the scene.

    Attributes:
        file_name: the image, in the folder of the line's file (the key of Hugging Face `imagefolder`).
        x, y, z: centre of the cylinder, or reference point of the mesh, camera frame, m.
        f, S: focal length and side of the image, px.
        scale: size factor of the cylinder.
        visibility: visible pixels of the cylinder over those visible without other objects; 0 if there are none.
        truncation: share of the cylinder's silhouette, without other objects, that lies outside the image.
        index, split, seed: determine everything else, given the specification.
        scene, view: number of the scene in the split, and of the view of that scene. Each frame of a sequence is a
            scene.
        track, time: of a frame: the name of its sequence, and seconds since its first frame.
        sha256: checksum of the image file.
    """

    file_name: Annotated[str, Field(pattern=r"^[0-9]{6,12}\.(png|webp|jpg)$")]
    x: Finite
    y: Finite
    z: Positive
    f: Positive
    S: Annotated[int, Field(gt=0)]
    scale: Positive
    visibility: Share
    truncation: Share
    index: Count
    split: Split
    seed: Count
    scene: Count
    view: Count
    pose: Pose
    objects: Objects
    lamps: tuple[Lamp, ...]
    backdrop: Backdrop
    noise_seed: Seed
    surroundings: OfMesh = None
    real_camera: OfBox = None
    real_box: Box = None
    track: Track = None
    time: OfSequence = None
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

    @property
    def as_scene(self) -> Scene:
        """The scene of this image, the renderer's input."""
        return Scene(**{key: getattr(self, key) for key in Scene.model_fields})
