"""The specification of a data set, from which each of its samples follows, and its shares (shards)."""

import hashlib
import json
import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, model_serializer, model_validator

from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.assets import BLENDERS_SKIES, Asset, backdrops_asset, mesh_asset
from phd_exp.records.cameras import Calibration, calibration
from phd_exp.records.parsing import Record

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"the lower bound {bounds[0]} exceeds the upper bound {bounds[1]}")
    return bounds


Positive = Annotated[Number, Field(gt=0)]
FocalLength = Annotated[Number, Field(ge=10, le=1e6)]
Distance = Annotated[Number, Field(ge=0.001, le=1e5)]
Factor = Annotated[Number, Field(ge=0.1, le=2)]
Share = Annotated[Number, Field(ge=0, le=1)]
# beyond a right angle, half the cameras would face the lamps
Angle = Annotated[Number, Field(ge=0, le=90)]
Pitch = Annotated[Number, Field(ge=-90, le=90)]
Side = Annotated[Number, Field(ge=0.2, le=10)]
Turn = Annotated[Number, Field(ge=0, le=180)]
Spin = Annotated[Number, Field(ge=0, le=3600)]
Range = AfterValidator(_ascending)


def _point(given: Any) -> Any:
    if given not in ("origin", "centroid") and not (isinstance(given, (list, tuple)) and len(given) == 3):
        raise ValueError("expected origin, centroid or [x, y, z] in units of the file")
    return given


Reference = Annotated[Literal["origin", "centroid"] | tuple[Number, Number, Number], BeforeValidator(_point)]
Mesh = BeforeValidator(mesh_asset)
ImageFormat = Literal["png", "webp", "jpeg"]
NEAREST = 1.05  # least depth of an object's centre over its reach, so that the camera stays outside
SOLID = 0.2 * 0.75**0.5  # m: reach of the cube, the largest solid at scale 1
F_RANGE = (1200.0, 2000.0)  # of meshes without a camera
XY_RANGES = {"field": 0.5, "box": 1.0}  # of meshes, by view


class DatasetSpec(Record):
    """Everything that a sample depends on, except its split and index. It does not hold the number of samples.

    Positions have the distribution z ~ U(z_range) and x, y ~ (S z / f) xy_range U(-1/2, 1/2). With view=box, their
    pixels in the image of `camera` are uniform instead: in the central share xy_range of the part at least
    edge_distance away from the edges. S and f are then those of the view of the object's box.

    Attributes:
        variant: name of the data set, and of its folder.
        seed: root of every random stream.
        sensor_size: S, side of the square image, px.
        f_range: bounds of the focal length, px.
        z_range: bounds of the depth of every object's centre, m.
        xy_range: share of the image's width and height that centres span: 1.0 in the paper's text, 0.5 in its
            authors' generator.
        scale_range: bounds of each object's size factor; (1, 1) makes sizes known.
        occluders: whether to add a cube and a sphere.
        lamp_jitter: largest relative change of a lamp's place and power.
        samples_per_pixel: light paths traced per pixel, before denoising.
        views: cameras per scene; sample i is view i mod views of scene i div views.
        view_angle_range: bounds of the angle between the lines of sight of a further view and the first, degrees.
        image_format: png keeps every pixel, webp and jpeg are small.
        image_quality: of webp and jpeg, per cent.
        saturation_range: bounds of the saturation of every colour; near 0 it is grey.
        half_hidden: whether a panel in front of the cylinder hides half of it. It replaces the cube of `occluders`.
        frames: images of each scene and camera. With one view, sample i is frame (i mod frames) of scene
            (i div frames); with several, the views of a frame follow one another. `rendering/sequences.py` describes
            the motion.
        frame_rate: frames per second.
        speed: root mean square speed of each object along each axis, m/s.
        spin_range: bounds of the rate at which each object turns, degrees per second.
        camera_speed, camera_turn: root mean square rates of the camera along and about each axis, m/s and degrees per
            second.
        mesh: the object instead of the cylinder. The following keys are for meshes alone.
        unit: metres per unit of the meshes' files.
        reference: the point whose position is predicted: the file's origin, the centroid of the surface, or a point
            in the file's units and axes.
        upright: whether the object is only turned about the vertical.
        resting: whether it lies on a random one of the sides on which it is stable.
        pitch_range: bounds of the angle by which the first camera looks down, degrees; negative: up.
        backdrops: Blender's skies, or the user's photographs and skies; None: the grey backdrop.
        ground: whether the upright or resting object lies on a plane, which shows its shadow.
        distractors: number of other objects, of the three solids and `distractor_meshes`.
        copies: number of further objects like the first one, with the same look, beside it.
        motion_blur: the longest path of the image during the exposure, px.
        ignore: parts of the meshes' files: the materials, in whose place are random ones.
        empty: whether the images show the scenes without their objects.
        camera: the user's camera. f_range is then the focal length of its whole image, shrunk to S.
        view: field, the whole image; box, the view of a detector's box, which `predict boxes=` makes too. None, to
            which the other values are reduced where possible: box if there is a camera, field if not.
        box_size, box_shift: bounds of the side of that box, and its largest shift, over the side of the exact one.
        edge_distance: least distance of the object's reference point from the edges of the user's image, in radii of
            the object. With smaller values more objects are cut off; with negative ones, reference points may lie
            outside the image.
        grey: whether the images are grey.
        looks: varied: random patterns, materials and tones, other shapes of distractors, and hard light.
        front: a direction in the file's axes; its angle to the way to the camera is in `front_range`, degrees.

    Raises:
        pydantic.ValidationError: a missing or unknown key, a wrong type, a value out of range.

    Source: paper, section "Dataset".
    """

    variant: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**63)]
    sensor_size: Annotated[int, Field(strict=True, ge=16, le=4096)]
    f_range: Annotated[tuple[FocalLength, FocalLength], Range]
    z_range: Annotated[tuple[Distance, Distance], Range]
    xy_range: Annotated[Number, Field(ge=0, le=1)]
    scale_range: Annotated[tuple[Factor, Factor], Range]
    occluders: StrictBool
    lamp_jitter: Annotated[Number, Field(ge=0, le=0.5)]
    samples_per_pixel: Annotated[int, Field(strict=True, ge=1, le=4096)]
    views: Annotated[int, Field(strict=True, ge=1, le=64)]
    view_angle_range: Annotated[tuple[Angle, Angle], Range]
    image_format: ImageFormat
    image_quality: Annotated[int, Field(strict=True, ge=1, le=100)]
    saturation_range: Annotated[tuple[Share, Share], Range] = (0.45, 0.95)
    half_hidden: StrictBool = False
    frames: Annotated[int, Field(strict=True, ge=1, le=10_000)] = 1
    frame_rate: Annotated[Number, Field(ge=0.1, le=10_000)] = 30.0
    speed: Annotated[Number, Field(ge=0, le=100)] = 0.5
    spin_range: Annotated[tuple[Spin, Spin], Range] = (0.0, 90.0)
    camera_speed: Annotated[Number, Field(ge=0, le=100)] = 0.0
    camera_turn: Angle = 0.0
    mesh: Annotated[Asset | None, Mesh] = None
    unit: Annotated[Number, Field(gt=0, le=1000)] = 1.0
    reference: Reference = "origin"
    upright: StrictBool = False
    pitch_range: Annotated[tuple[Pitch, Pitch], Range] = (0.0, 0.0)
    backdrops: Annotated[Literal["hdri"] | Asset | None, BeforeValidator(backdrops_asset)] = None
    ground: StrictBool = False
    distractors: Annotated[int, Field(strict=True, ge=0, le=12)] = 0
    distractor_meshes: tuple[Annotated[Asset, Mesh], ...] = ()
    motion_blur: Annotated[Number, Field(ge=0, le=64)] = 0.0
    ignore: tuple[Literal["materials"], ...] = ()
    empty: StrictBool = False
    camera: Calibration | None = None
    view: Literal["field", "box"] | None = None
    box_size: Annotated[tuple[Side, Side], Range] = (0.9, 1.5)
    box_shift: Annotated[Number, Field(ge=0, le=0.5)] = 0.15
    edge_distance: Annotated[Number, Field(ge=-1, le=2)] = 0.5
    grey: StrictBool = False
    looks: Literal["plain", "varied"] = "plain"
    front: tuple[Number, Number, Number] | None = None
    front_range: Annotated[tuple[Turn, Turn], Range] = (0.0, 90.0)
    resting: StrictBool = False
    copies: Annotated[int, Field(strict=True, ge=0, le=12)] = 0

    @model_validator(mode="before")
    @classmethod
    def _follow_camera(cls, values: Any) -> Any:
        """Read the camera, and fill in what follows from it: f_range and xy_range, if they are null."""
        if not isinstance(values, dict) or values.get("mesh") is None:
            return values
        camera = calibration(values.get("camera"))
        usual = "box" if camera else "field"
        view = values.get("view") or usual
        followed = values | {"camera": camera, "view": None if view == usual else view}
        if values.get("xy_range") is None:
            followed["xy_range"] = XY_RANGES.get(view)
        if camera and "sensor_size" in values:
            followed["f_range"] = _whole(camera, view, values["sensor_size"], values.get("f_range"))
        elif values.get("f_range", F_RANGE) is None:
            followed["f_range"] = F_RANGE
        return followed

    @property
    def is_box(self) -> bool:
        """Whether the images are views of boxes."""
        return self.camera is not None and self.view is None

    @model_validator(mode="after")
    def _is_a_scene(self) -> "DatasetSpec":
        """Refuse the first combination of values that no kind of scene has."""
        for is_wrong, complaint in _combinations(self, set(self.model_dump())):
            if is_wrong:
                raise ValueError(complaint)
        return self

    @property
    def without_objects(self) -> "DatasetSpec":
        """The data set of the same images without their objects."""
        return self.model_copy(update={"variant": f"{self.variant}-backdrops", "empty": True})

    def backdrop_files(self, split: str) -> list[str]:
        """Names of the backdrops of a split: every fourth is for test samples alone."""
        names = self.backdrops.files if isinstance(self.backdrops, Asset) else BLENDERS_SKIES
        of_split = [name for number, name in enumerate(names) if (number % 4 == 3) == (split == "test")]
        return of_split if self.backdrops else []

    @model_serializer(mode="wrap")
    def _without_defaults(self, serialize: Any) -> dict[str, Any]:
        # younger keys at their defaults are not written: fingerprints and manifests stay as they were
        return {key: value for key, value in serialize(self).items() if not self._is_usual(key)}

    def _is_usual(self, key: str) -> bool:
        """Whether a key has its default."""
        return bool(getattr(self, key) == type(self).model_fields[key].default)

    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that identify the values, the same on every machine."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _combinations(spec: DatasetSpec, given: set[str]) -> list[tuple[object, str]]:
    """Whether a specification, with these keys beyond their defaults, combines what does not fit; and what.

    A scene shows a cylinder, in single images or sequences, or a mesh, in the field or in a box. Each kind has keys
    that have their defaults in all others.
    """
    keys, is_mesh = list(DatasetSpec.model_fields), spec.mesh is not None
    of_meshes, of_boxes = given & set(keys[keys.index("unit") :]), given & {"box_size", "box_shift", "edge_distance"}
    moving = given & {"frame_rate", "speed", "spin_range", "camera_speed", "camera_turn"}
    laws = [key for key in ("upright", "resting", "front") if getattr(spec, key)]
    near, others = NEAREST * SOLID * spec.scale_range[1], 3 + len(spec.distractor_meshes)
    alone = "view=box" * spec.is_box or "distractors or copies" * bool(spec.distractors or spec.copies)
    # the camera is above the ground at the upper border of the image
    steepest = math.degrees(math.atan(spec.sensor_size / 2 / spec.f_range[0]))
    is_floor = (spec.upright or spec.resting) and spec.views == 1 and spec.pitch_range[0] > steepest
    return [
        (of_meshes and not is_mesh, f"{_names(of_meshes)}: for meshes alone; expected data=object data.mesh=FILE"),
        (
            not is_mesh and near > spec.z_range[0],
            f"z_range: got {list(spec.z_range)}; expected at least {near:.3g} m, outside the objects",
        ),
        (is_mesh and spec.occluders, "occluders: for the cylinder alone; expected data.distractors=2"),
        (is_mesh and spec.frames > 1, f"frames: got {spec.frames}; sequences are of the cylinder; expected 1"),
        (moving and spec.frames == 1, f"{_names(moving)}: nothing moves in single images; expected data=sequence"),
        (spec.view == "box", "view: got box; expected data.camera=FILE, or data.f, data.width and data.height"),
        (of_boxes and not spec.is_box, f"{_names(of_boxes)}: got view=field; expected view=box"),
        (alone and spec.views > 1, f"views: got {spec.views} with {alone}; expected 1"),
        (
            "front_range" in given and not any(spec.front or ()),
            "front: expected a direction [x, y, z] with front_range",
        ),
        (laws[1:], f"{' and '.join(laws)}: different laws of rotations; expected one of them"),
        (spec.distractors > others, f"distractors: got {spec.distractors}; expected at most {others}"),
        (
            spec.ground and not is_floor,
            f"ground: got upright={spec.upright}, resting={spec.resting}, views={spec.views}, pitch_range="
            f"{list(spec.pitch_range)}; expected upright or resting, views=1, and pitch_range above {steepest:.3g} "
            "degrees, so that no horizon is in view",
        ),
    ]


def _names(keys: set[str]) -> str:
    return ", ".join(sorted(keys))


def _whole(camera: Calibration, view: str, S: int, given: Any) -> tuple[float, float]:
    """f_range of the whole image of a camera. Raises ValueError if another one is given."""
    size = (float(camera.width or 0), float(camera.height or 0))
    f = camera.K[0] * S / max(size)
    if view == "field":
        f = VirtualCamera.of_box(camera.intrinsics, (0.0, 0.0, *size), float(S), camera.lens).f
    if given is not None and tuple(given) != (f, f):
        raise ValueError(f"f_range: got {list(given)}, but it follows from data.camera; leave it out")
    return f, f


@dataclass(frozen=True)
class Shard:
    """The samples of each split whose index is `index` modulo `count`: shares of equal cost."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: Any) -> "Shard":
        """The shard that a user writes as `0/4`. Raises ValueError for anything else."""
        match = re.fullmatch(r"(\d+)/(\d+)", text) if isinstance(text, str) else None
        if match is None or int(match[1]) >= int(match[2]):
            raise ValueError("expected INDEX/COUNT with 0 <= INDEX < COUNT, such as 0/4")
        return cls(int(match[1]), int(match[2]))

    def holds(self, index: int) -> bool:
        """Whether the shard contains the sample with this index."""
        return index % self.count == self.index
