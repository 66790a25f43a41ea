"""A scene as data, and the line of `metadata.jsonl` that says what an image shows.

Camera frame: x right, y down, z forward, metres. A scene's own frame is the camera frame of its first view. An
object's local frame has its origin at the object's centre; a cylinder's axis is the local z axis.
"""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Split = Literal["train", "test"]
Shape = Literal["cylinder", "cube", "sphere"]
Material = Literal["rubber", "metal"]
LampName = Literal["key", "fill", "back"]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[Finite, Finite, Finite]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Count = Annotated[int, Field(ge=0)]


def _unit(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > 1e-6:
        raise ValueError(f"a rotation is a unit quaternion, this one has norm {norm:.6g}")
    return quaternion


Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_unit)]


class _Described(BaseModel):
    """Immutable and exact: an unknown or missing key in a file is an error, not a surprise later."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SceneObject(_Described):
    """One rigid object.

    Attributes:
        position: centre, scene frame, m.
        rotation: unit quaternion (w, x, y, z) turning local axes into the scene's.
        dimensions: extent along the local axes at scale 1, m.
        scale: factor on all three dimensions.
        colour: sRGB.
    """

    shape: Shape
    position: tuple[Finite, Finite, Positive]
    rotation: Quaternion
    dimensions: tuple[Positive, Positive, Positive]
    scale: Positive
    colour: tuple[Share, Share, Share]
    material: Material


class Lamp(_Described):
    """A square area lamp: its place and the point it faces (scene frame, m), side (m), power (W)."""

    name: LampName
    position: Vector
    towards: Vector
    side: Positive
    power: Positive


class Backdrop(_Described):
    """The light-grey ground behind everything: linear brightness level (1 - falloff |p - centre|^2).

    p is the place in the image in units of its side, x right and y down from the top left corner. As a
    function of the pixel alone, the backdrop tells neither depth nor focal length.
    """

    level: Share
    falloff: Share
    centre: tuple[Finite, Finite]


class Pose(_Described):
    """Where a camera stands, as the motion from the scene's frame to its own: p_camera = R p_scene + translation.

    Attributes:
        rotation: unit quaternion (w, x, y, z) of R.
        translation: m.
    """

    rotation: Quaternion
    translation: Vector


FIRST_VIEW = Pose(rotation=(1.0, 0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0))


def _one_of_each(objects: tuple[SceneObject, ...]) -> tuple[SceneObject, ...]:
    shapes = [item.shape for item in objects]
    if shapes[0] != "cylinder" or len(set(shapes)) < len(shapes):
        raise ValueError(f"a scene is a cylinder first, then other shapes, each once; these are {shapes}")
    return objects


Objects = Annotated[tuple[SceneObject, ...], Field(min_length=1), AfterValidator(_one_of_each)]


class Scene(_Described):
    """All that the renderer needs for one image.

    Attributes:
        f: focal length, px; the principal point is the middle of the image.
        S: side of the square image, px.
        pose: of the camera.
        objects: the cylinder first.
        noise_seed: seed of the path tracer.
    """

    f: Positive
    S: Annotated[int, Field(gt=0)]
    pose: Pose
    objects: Objects
    lamps: tuple[Lamp, ...]
    backdrop: Backdrop
    noise_seed: Seed


class SampleRecord(_Described):
    """One line of `metadata.jsonl`: the image's name, what a network is asked for, how the image came to be.

    Attributes:
        file_name: the image, beside the line's own file (the name Hugging Face `imagefolder` asks for).
        x, y, z: centre of the cylinder, camera frame, m.
        f, S: focal length and side of the image, px.
        scale: size factor of the cylinder.
        visibility: visible pixels of the cylinder over those it would show alone; 0 if it would show none.
        truncation: share of the cylinder's silhouette, alone, that lies outside the image.
        index, split, seed: the three numbers from which everything else follows, given the specification.
        scene, view: which scene of the split the image shows, and which of its views it is.
        sha256: of the image file.
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
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

    @property
    def shown(self) -> Scene:
        """What this image shows, as the renderer takes it."""
        return Scene(
            f=self.f,
            S=self.S,
            pose=self.pose,
            objects=self.objects,
            lamps=self.lamps,
            backdrop=self.backdrop,
            noise_seed=self.noise_seed,
        )
