"""Reading the user's own images, and resampling them to the views of virtual cameras."""

import io
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image

from phd_exp.data.areas import GREY, view
from phd_exp.data.images import shrunk
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.detections import LARGEST_BOX, Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.files import require_plain
from phd_exp.records.images import FORMATS, LARGEST_IMAGE, decoding, pillow_warnings

PLAIN = ("1", "L", "RGB", "YCbCr", "CMYK")
WITH_ALPHA = ("P", "PA", "LA", "La", "RGBA", "RGBa")  # a palette may contain a transparent colour
SIXTEEN_BITS = ("I;16", "I;16L", "I;16B", "I;16N")
TURNED = range(2, 9)  # EXIF orientations; others than 1 to 8 mean nothing
TWELVE_BITS = 1 << 12
ONE_PICTURE = ("JPEG", "MPO")  # formats whose further frames are previews and depth maps
STRIP = 1 << 17  # about the pixels of the image that a strip of a view reads; the sums of three bands take 3 MB
WIDEST = 100.0  # m that the view of an object may show at its distance
MARGIN = 1  # pixels around a view of more pixels than the image has, which are interpolated


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
        if orientation in TURNED:
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

    Raises DatasetError if the box is too wide, or as `Detection.optics`.
    """
    box = detection.box(*size)
    K, lens = detection.optics(*size)
    try:
        return VirtualCamera.of_box(K, box, float(side), lens)
    except ValueError as error:
        raise DatasetError(f"{detection.where}: {error}") from None


def true_position(
    detection: Detection, size: tuple[int, int], camera: VirtualCamera, widest: float = WIDEST
) -> Float[np.ndarray, "3"]:
    """The true position of a detection in the frame of its virtual camera, m.

    `size` is the width and height of the image, and `widest` the most that the view may show at that distance, m.
    Raises DatasetError if the detection has none, or one that cannot be right.
    """
    xyz = camera.to_virtual(np.array(detection.position))
    fault = f"{detection.where}: the position {list(detection.position)}"
    off_centre = camera.real_pixels(xyz[:2] / xyz[2]) - np.array(size) / 2 if xyz[2] > 0 else np.nan
    if not np.all(np.abs(off_centre) <= LARGEST_BOX * max(size)):
        raise DatasetError(
            f"{fault} is far outside the image of {size[0]} x {size[1]} pixels, or 90 degrees or more from the middle"
            " of its box; check x, y, z (m) and the camera"
        )
    if (width := camera.S * xyz[2] / camera.f) > widest:
        raise DatasetError(
            f"{fault} is so far away that its box is {width:.3g} m wide there; expected metres, and a width of at "
            f"most {widest:.3g} m; if these are millimetres, divide them by 1000"
        )
    return xyz


Picture = Image.Image | UInt8[np.ndarray, "height width 3"]
"""An RGB image, as an array or of Pillow."""


def cut(image: Picture, camera: VirtualCamera) -> UInt8[np.ndarray, "S S 3"]:
    """The virtual camera's view of an RGB image of its real camera; grey beyond the edges of the image.

    The pixels are means over areas, see `view`. A square image viewed as a whole is `shrunk`, to the same pixels in
    less time. Other views are computed in strips that fit in the cache of a processor.
    """
    size = image.size if isinstance(image, Image.Image) else (image.shape[1], image.shape[0])
    if _is_whole(size, camera) and size[0] >= camera.S:
        return shrunk(np.asarray(image), int(camera.S))
    corners = corners_of(camera)
    left, top, right, bottom = _reach(corners, size)
    rows = max(1, int(camera.S * STRIP / ((right - left) * (bottom - top))))
    firsts = range(0, int(camera.S), rows)
    return np.concatenate([_strip(image, size, corners[first : first + rows + 1]) for first in firsts])


def corners_of(camera: VirtualCamera) -> Float[np.ndarray, "places places 2"]:
    """Pixels of the real image at the corners of the pixels of the virtual image; NaN where the lens sees nothing."""
    return camera.grid(np.linspace(-1, 1, int(camera.S) + 1))


def _strip(
    image: Picture, size: tuple[int, int], corners: Float[np.ndarray, "lower further 2"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The pixels with these corners."""
    left, top, right, bottom = part = _reach(corners, size)
    pixels = image.crop(part) if isinstance(image, Image.Image) else image[top:bottom, left:right]
    return view(torch.from_numpy(np.array(pixels)), torch.from_numpy(corners - part[:2])).numpy()


def _is_whole(size: tuple[int, int], camera: VirtualCamera) -> bool:
    """Whether the view is a whole square image of that size, on fewer or more pixels."""
    zoom = camera.S / size[0]
    whole = size[0] == size[1] and np.array_equal(camera.R, np.eye(3))
    whole = whole and camera.lens.is_pinhole
    return whole and np.allclose(camera.homography, np.diag([zoom, zoom, 1]), rtol=0, atol=1e-9)


def _reach(corners: Float[np.ndarray, "rows columns 2"], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the part of the image that the pixels with these corners read; never empty."""
    places = corners.reshape(-1, 2)  # NaN where the real camera sees nothing
    left, top = np.floor(np.fmin.reduce(places) - MARGIN).clip(0, np.array(size) - 1).astype(int).tolist()
    right, bottom = np.ceil(np.fmax.reduce(places) + MARGIN).clip(1, size).astype(int).tolist()
    return left, top, right, bottom


def _as_rgb(file: Path, image: Image.Image) -> Image.Image:
    if image.mode in SIXTEEN_BITS:
        if 0 < (largest := int(np.asarray(image).max())) < TWELVE_BITS:
            raise DatasetError(
                f"{file}: the largest of its 16-bit values is {largest}; expected the whole range up to 65535: "
                "multiply 12-bit values by 16, 14-bit values by 4"
            )
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8)).convert("RGB")
    if image.mode in WITH_ALPHA:
        over, ground = image.convert("RGBA"), Image.new("RGB", image.size, (GREY, GREY, GREY))
        ground.paste(over, mask=over)
        return ground
    if image.mode in PLAIN:
        return image if image.mode == "RGB" else image.convert("RGB")  # `convert` copies an image that is RGB
    raise DatasetError(f"{file}: has colours of the kind {image.mode!r}; save it as RGB of 8 bits")
