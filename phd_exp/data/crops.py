"""Reading the user's own images, and resampling them to the views of virtual cameras."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image
from scipy.ndimage import map_coordinates

from phd_exp.data.images import shrunk
from phd_exp.geometry.lens import PINHOLE, Lens
from phd_exp.geometry.virtual import VirtualCamera, intrinsics, require_no_fold
from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.files import require_plain
from phd_exp.records.images import FORMATS, LARGEST_IMAGE, decoding, pillow_warnings

GREY = (128, 128, 128)  # the colour of transparent pixels and of those beyond the edges of an image
PLAIN = ("1", "L", "RGB", "YCbCr", "CMYK")
WITH_ALPHA = ("P", "PA", "LA", "La", "RGBA", "RGBa")  # a palette may contain a transparent colour
SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N")
ONE_PICTURE = ("JPEG", "MPO")  # formats whose further frames are previews and depth maps
MARGIN = 2  # pixels around a position read by bicubic interpolation
FINE = 4  # samples along a pixel of the view at the lowest density
FINEST = 16
"""Largest number of samples along a pixel of the view; near 90 degrees from the optical axis it has no bound."""
LARGEST_STRIPE = 1 << 22  # samples in memory at once
LENS_COST = 8  # memory of a sample through a lens, in samples of a pinhole


def image_size(file: Path) -> tuple[int, int]:
    """Width and height from the header of the file. Raises DatasetError if it is not an image."""
    with decoding(file), pillow_warnings():
        require_plain(file, LARGEST_IMAGE)
        with Image.open(file, formats=FORMATS) as image:
            return image.size


def read_image(file: Path, content: bytes) -> Image.Image:
    """The image as RGB: grey, palette and 16 bits (its upper 8) converted, transparency composed over grey.

    Raises DatasetError, naming the file, if it is not one whole image, exceeds Pillow's limit of pixels, has an EXIF
    orientation (the pixels of the intrinsics are then ambiguous), or its colours cannot be converted to RGB.
    """
    with decoding(file), Image.open(io.BytesIO(content), formats=FORMATS) as image:
        # before loading, during which Pillow rotates a TIFF
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        if orientation != 1:
            raise DatasetError(
                f"{file}: has the EXIF orientation {orientation}, so that its stored pixels are turned; "
                "turn them for good (`mogrify -auto-orient`), and let f, cx, cy and box refer to the result"
            )
        if getattr(image, "is_animated", False) and image.format not in ONE_PICTURE:
            raise DatasetError(f"{file}: holds several pictures; expected one, saved as a separate file")
        image.load()
        return _as_rgb(file, image)


def facing(detection: Detection, size: tuple[int, int], side: int) -> VirtualCamera:
    """The virtual camera that faces a detection in an image of that width and height.

    Raises DatasetError if the box is too wide, the camera file is for another size, or its lens folds over inside.
    """
    box, K, file = detection.box(*size), intrinsics(*detection.focal_lengths_and_centre(*size)), detection.calibration
    lens = Lens(file.D[:8], file.model == "equidistant") if file else PINHOLE
    try:
        require_no_fold(K, lens, *size)
        return VirtualCamera.of_box(K, box, float(side), lens)
    except ValueError as error:
        raise DatasetError(f"{detection.where}: {error}") from None


def cut(image: Image.Image, camera: VirtualCamera) -> UInt8[np.ndarray, "S S 3"]:
    """The virtual camera's view of an RGB image of its real camera; grey beyond the edges of the image.

    A square image viewed as a whole is `shrunk`. Any other view averages bicubic samples over the area of each pixel;
    through a lens, samples of cubic splines.
    If an image has many pixels per pixel of the view, blocks of them are averaged first. The memory does not depend
    on the density of the samples.
    """
    S = int(camera.S)
    if _is_whole(image, camera) and image.width >= S:
        return shrunk(np.asarray(image), S)
    fewest, most = camera.densities
    block = max(1, int(fewest / FINE))
    left, top, right, bottom = _reach(image, camera)
    across, down = -(-(right - left) // block), -(-(bottom - top) // block)
    finest = min(FINEST, 2 * max(across, down) / S)
    multiple = max(1, math.ceil(min(most / block, finest) - 1e-6))  # 2.0000000001 is two
    visible = Image.new("RGB", (block * across, block * down), GREY)
    visible.paste(image.crop((left, top, right, bottom)))
    bands = [band.convert("F") for band in visible.reduce(block).split()]
    back = np.diag([1 / block, 1 / block, 1.0]) @ np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1]])
    back = back @ np.linalg.inv(camera.homography) @ np.diag([1 / multiple, 1 / multiple, 1.0])
    view = np.empty((S, S, 3), dtype=np.uint8)
    step = max(1, LARGEST_STRIPE // (S * multiple**2 * (1 if camera.lens.is_pinhole else LENS_COST)))
    for first in range(0, S, step):
        rows = min(step, S - first)
        if camera.lens.is_pinhole:
            stripe = back @ np.array([[1, 0, 0], [0, 1, first * multiple], [0, 0, 1]])
            samples = _sampled(bands, stripe, S * multiple, rows * multiple)
        else:
            x, y = ((np.arange(n) + 0.5) / multiple - S / 2 for n in (S * multiple, rows * multiple))
            seen = camera.real_pixels(np.stack(np.meshgrid(x, y + first), axis=-1) / camera.f)
            samples = _interpolated(bands, (seen - (left, top)) / block)
        means = samples.reshape(rows, multiple, S, multiple, 3).mean(axis=(1, 3), dtype=np.float64)
        view[first : first + rows] = means.round().clip(0, 255)
    return view


def _is_whole(image: Image.Image, camera: VirtualCamera) -> bool:
    """Whether the view is a whole square image, on fewer or more pixels."""
    zoom = camera.S / image.width
    whole = image.width == image.height and np.array_equal(camera.R, np.eye(3))
    whole = whole and camera.lens.is_pinhole
    return whole and np.allclose(camera.homography, np.diag([zoom, zoom, 1]), rtol=0, atol=1e-9)


def _reach(image: Image.Image, camera: VirtualCamera) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of the image that the view reads; never empty."""
    S = camera.S
    corners = np.linalg.inv(camera.homography) @ np.array([[0, S, 0, S], [0, 0, S, S], [1, 1, 1, 1]])
    reached = (corners[:2] / corners[2]).T
    if not camera.lens.is_pinhole:
        reached = camera.grid[np.isfinite(camera.grid[..., 0])]
    size = np.array(image.size)
    reached = reached.clip(-MARGIN, size + MARGIN)
    left, top = np.floor(reached.min(axis=0) - MARGIN).clip(0, size - 1).astype(int).tolist()
    right, bottom = np.ceil(reached.max(axis=0) + MARGIN).clip(1, size).astype(int).tolist()
    return left, top, right, bottom


def _sampled(
    bands: Sequence[Image.Image], back: Float[np.ndarray, "3 3"], width: int, height: int
) -> Float[np.ndarray, "height width 3"]:
    """Bicubic samples at the pixels to which `back` maps those of a `width` x `height` image."""
    # in Pillow's coordinates, too, the centre of a pixel is (column + 1/2, row + 1/2)
    coefficients = (back / back[2, 2]).flatten()[:8].tolist()
    how = ((width, height), Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BICUBIC)
    # band by band in floating point: Pillow truncates the samples of bytes
    samples = [band.transform(*how, fillcolor=grey) for band, grey in zip(bands, GREY, strict=True)]
    return np.stack([np.asarray(band) for band in samples], axis=-1)


def _interpolated(
    bands: Sequence[Image.Image], places: Float[np.ndarray, "height width 2"]
) -> Float[np.ndarray, "height width 3"]:
    """Samples of cubic splines at places of the bands; grey beyond their edges and at NaN."""
    inside = ((places >= 0) & (places < bands[0].size)).all(axis=-1)
    row_column = np.moveaxis(np.where(inside[..., None], places - 0.5, 0)[..., ::-1], -1, 0)
    samples = [map_coordinates(np.asarray(band), row_column, order=3, mode="nearest") for band in bands]
    return np.where(inside[..., None], np.stack(samples, axis=-1), GREY)


def _as_rgb(file: Path, image: Image.Image) -> Image.Image:
    if image.mode in SIXTEEN_BITS:
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8)).convert("RGB")
    if image.mode in WITH_ALPHA:
        over, ground = image.convert("RGBA"), Image.new("RGB", image.size, GREY)
        ground.paste(over, mask=over)
        return ground
    if image.mode in PLAIN:
        return image.convert("RGB")
    raise DatasetError(f"{file}: has colours of the kind {image.mode!r}; save it as RGB of 8 bits")
