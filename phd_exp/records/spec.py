"""What a data set is, said once: the few numbers from which every one of its samples follows."""

import hashlib
import json
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictBool

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


def _ascending(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError(f"the lower bound {bounds[0]} exceeds the upper bound {bounds[1]}")
    return bounds


Positive = Annotated[Number, Field(gt=0)]
FocalLength = Annotated[Number, Field(ge=10, le=1e6)]
# Half a metre keeps the camera outside the largest object (a cube of 0.2 m, scaled by 2, reaches 0.35 m).
Distance = Annotated[Number, Field(ge=0.5, le=100)]
Factor = Annotated[Number, Field(ge=0.1, le=2)]
# Beyond a right angle, half the cameras would look at the lamps.
Angle = Annotated[Number, Field(ge=0, le=90)]
Range = AfterValidator(_ascending)
ImageFormat = Literal["png", "webp", "jpeg"]


class DatasetSpec(BaseModel):
    """Everything a sample depends on, besides its split and index; the number of samples is no part of it.

    A position is drawn as z ~ U(z_range) and x, y ~ (S z / f) xy_range U(-1/2, 1/2).

    Attributes:
        variant: name of the data set, and of its folder.
        seed: root of every random stream.
        sensor_size: S, side of the square image, px.
        f_range: bounds of the focal length, px.
        z_range: bounds of the depth of every object's centre, m.
        xy_range: share of the image's width and height over which centres are spread: 1.0 is the paper's
            text, 0.5 its authors' generator.
        scale_range: bounds of each object's own size factor; (1, 1) leaves sizes known.
        occluders: whether a cube and a sphere join the cylinder.
        lamp_jitter: largest relative change of a lamp's place and strength.
        samples_per_pixel: light paths traced per pixel, before denoising.
        views: cameras that look at each scene; sample i is view i mod views of scene i div views.
        view_angle_range: bounds of the angle between a further view's line of sight and the first's, degrees.
        image_format: of the files; png keeps every pixel, webp and jpeg are small.
        image_quality: of webp and jpeg, in per cent.

    Raises:
        pydantic.ValidationError: a missing or unknown key, a wrong type, a value out of range.

    Source: paper, section "Dataset".
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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

    @property
    def z_over_f_range(self) -> tuple[float, float]:
        """Smallest and largest z / f (m/px) that a sample can have; mu_z0 and D follow from them."""
        return self.z_range[0] / self.f_range[1], self.z_range[1] / self.f_range[0]

    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that differ whenever any value differs, the same on every machine."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]
