"""The user's own images: read as what they are or refused in one line, and resampled to a fraction of a pixel."""

import io
import math
import multiprocessing
import resource
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from phd_exp.data.areas import GREY, area_means, sums, view
from phd_exp.data.crops import cut, pillow_warnings, read_image
from phd_exp.data.images import shrunk
from phd_exp.geometry import Camera
from phd_exp.optics.virtual import Box, VirtualCamera, intrinsics, rays
from phd_exp.records.errors import DatasetError

K = intrinsics(400.0, 520.0, 120.3, 140.8)  # pixels not square, the principal point off the middle
WIDTH, HEIGHT = 301, 220
PLACES = np.array([(a, b) for a in (0.25, 0.5, 0.75) for b in (0.25, 0.5, 0.75)])
"""Of blobs in a box, in units of its sides."""


def blobs(camera_K: np.ndarray, size: tuple[int, int], pixels: np.ndarray, sigma: float) -> Image.Image:
    """White blobs on black about the pixels given; the middle of a pixel is (column + 1/2, row + 1/2)."""
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    light = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2)) for x, y in pixels)
    grey = np.round(255 * np.asarray(light).clip(0, 1)).astype(np.uint8)
    return Image.fromarray(grey).convert("RGB")


def centroid(picture: np.ndarray, about: np.ndarray, reach: float) -> np.ndarray:
    light = picture[..., 0].astype(float)
    v, u = np.indices(light.shape) + 0.5
    light = light * ((u - about[0]) ** 2 + (v - about[1]) ** 2 < reach**2)
    return np.array([(u * light).sum(), (v * light).sum()]) / light.sum()


@pytest.mark.parametrize(
    ("zoom", "box", "S"),
    [
        (1, (0.0, 0.0, 301.0, 220.0), 301.0),
        (1, (150.0, 10.0, 290.0, 120.0), 140.0),
        (1, (10.5, 90.25, 110.5, 200.0), 200.0),  # enlarged
        (4, (400.0, 100.0, 1100.0, 700.0), 96.0),  # shrunk
        (4, (0.0, 0.0, 1204.0, 880.0), 100.0),
    ],
    ids=["whole", "off centre", "enlarged", "shrunk", "whole, shrunk"],
)
def test_what_lies_at_a_place_is_seen_where_the_virtual_camera_projects_it(zoom: int, box: Box, S: float) -> None:
    camera_K = np.diag([zoom, zoom, 1.0]) @ K
    left, top, right, bottom = box
    pixels = np.array([left, top]) + PLACES * [right - left, bottom - top]
    depth = np.linspace(2, 5, len(pixels))[:, None]
    xyz = depth * rays(camera_K, pixels)
    camera = VirtualCamera.of_box(camera_K, box, S)
    sigma = (right - left) / 80
    seen = cut(blobs(camera_K, (zoom * WIDTH, zoom * HEIGHT), pixels, sigma), camera)
    f = torch.tensor(camera.f, dtype=torch.float64)
    expected = Camera(f, S).project(torch.from_numpy(camera.to_virtual(xyz))).numpy()
    reach = 4.5 * sigma * camera.f / (camera_K[0, 0] * 1.0)
    for place in expected:
        assert np.abs(centroid(seen, place, reach) - place).max() < 0.05


def test_the_whole_of_a_square_image_is_itself() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    whole = (intrinsics(333.3, 333.3, 48.0, 48.0), (0.0, 0.0, 96.0, 96.0))
    np.testing.assert_array_equal(cut(Image.fromarray(noise), VirtualCamera.of_box(*whole, 96.0)), noise)
    for side in (32, 41):
        seen = cut(Image.fromarray(noise), VirtualCamera.of_box(*whole, float(side)))
        np.testing.assert_array_equal(seen, shrunk(noise, side))


COSTLY = [
    ((15_000, 1000), (5e3, 5e3, 75e2, 5e2), (0.0, 0.0, 15e3, 1e3)),  # a panorama
    ((100_000, 1), (1e5, 1e5, 5e4, 0.5), (0.0, 0.0, 1e5, 1.0)),
    # near 90 degrees from the axis
    ((1000, 1000), (251.2, 251.2, 200.2, -257.1), (418.3, 271.3, 818.3, 276.9)),
]


def limited(size: tuple[int, int], camera: VirtualCamera) -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 270_000_000,) * 2)
    assert cut(Image.new("RGB", size), camera).shape == (64, 64, 3)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("size", "matrix", "box"), COSTLY)
def test_a_view_of_any_image_takes_little_memory(size: tuple[int, int], matrix: tuple[float, ...], box: Box) -> None:
    camera = VirtualCamera.of_box(intrinsics(*matrix), box, 64.0)
    process = multiprocessing.get_context("fork").Process(target=limited, args=(size, camera))
    process.start()
    process.join()
    assert process.exitcode == 0


def saved(image: Image.Image, kind: str = "png", **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


RED = Image.new("RGB", (4, 3), (255, 0, 0))
KINDS: dict[str, tuple[bytes, tuple[int, int, int]]] = {
    "RGB": (saved(RED), (255, 0, 0)),
    "grey": (saved(Image.new("L", (4, 3), 77)), (77, 77, 77)),
    "black and white": (saved(Image.new("1", (4, 3), 1)), (255, 255, 255)),
    "16 bits": (saved(Image.fromarray(np.full((3, 4), 0x4D80, dtype=np.uint16))), (0x4D, 0x4D, 0x4D)),
    "palette": (saved(RED.convert("P")), (255, 0, 0)),
    "palette with a transparent colour": (saved(Image.new("P", (4, 3), 0), transparency=0), 3 * (GREY,)),
    "transparent": (saved(Image.new("RGBA", (4, 3), (255, 0, 0, 0))), 3 * (GREY,)),
    "opaque": (saved(Image.new("RGBA", (4, 3), (255, 0, 0, 255))), (255, 0, 0)),
    "half transparent grey": (saved(Image.new("LA", (4, 3), (0, 128))), (64, 64, 64)),
    "CMYK": (saved(Image.new("CMYK", (4, 3), (0, 255, 255, 0)), "tiff"), (255, 0, 0)),
}


@pytest.mark.parametrize(("content", "colour"), KINDS.values(), ids=KINDS.keys())
def test_all_kinds_of_colour_become_rgb(content: bytes, colour: tuple[int, int, int]) -> None:
    image = read_image(Path("a.png"), content)
    assert (image.mode, image.size) == ("RGB", (4, 3))
    assert np.abs(np.asarray(image).astype(int) - colour).max() <= 1


NOISE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8))


@pytest.mark.parametrize("kind", ["png", "jpeg", "tiff", "webp", "gif", "bmp"])
def test_a_file_cut_off_anywhere_is_one_line(kind: str, tmp_path: Path) -> None:
    whole = saved(NOISE, kind)
    assert read_image(Path("a"), whole).size == (40, 40)
    for length in [0, 1, 4, 10, 20, 30, 50, 100, len(whole) // 2, len(whole) * 9 // 10]:
        with (
            pillow_warnings(),
            pytest.raises(DatasetError, match=r"^a: (cannot be read as|not) an image.*") as caught,
        ):
            read_image(Path("a"), whole[:length])
        assert "\n" not in str(caught.value)


def test_bytes_turned_over_never_raise_anything_else() -> None:
    draw = np.random.default_rng(1)
    for kind in ("png", "jpeg", "tiff", "gif"):
        whole = np.frombuffer(saved(NOISE, kind), dtype=np.uint8)
        for _ in range(60):
            broken = whole.copy()
            broken[draw.integers(0, min(200, len(whole)), 3)] = draw.integers(0, 256, 3)
            with pillow_warnings(), suppress(DatasetError):
                read_image(Path("a"), broken.tobytes())


@pytest.mark.parametrize("kind", ["jpeg", "png", "tiff", "webp"])
@pytest.mark.parametrize("orientation", [0, 1, 3, 6, 9])
def test_an_orientation_is_neither_applied_nor_ignored(kind: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    content = saved(NOISE, kind, exif=exif)
    if orientation in (0, 1, 9):  # 0 and 9 mean nothing
        assert read_image(Path("a"), content).size == (40, 40)
        return
    with pytest.raises(DatasetError, match=rf"^a: has the EXIF orientation {orientation}.*mogrify -auto-orient"):
        read_image(Path("a"), content)


def test_sixteen_bits_with_twelve_in_use_are_refused_instead_of_black() -> None:
    """Of 16 bits the upper 8 are shown, and nothing is lost of a black image."""
    ramp = np.arange(4096, dtype=np.uint16).reshape(64, 64)
    with pytest.raises(DatasetError, match=r"^a: the largest of its 16-bit values is 4095; .* multiply .* by 16"):
        read_image(Path("a"), saved(Image.fromarray(ramp), "png"))
    shown = np.asarray(read_image(Path("a"), saved(Image.fromarray(16 * ramp), "png")))
    np.testing.assert_array_equal(shown[..., 0], ramp >> 4)
    assert not np.any(read_image(Path("a"), saved(Image.fromarray(0 * ramp), "png")))


@pytest.mark.parametrize("zoom", [1.0, 1.7, 6.0, 0.4])
@pytest.mark.parametrize("size", [(37, 50), (1, 1)], ids=str)
def test_a_view_is_the_mean_over_areas(size: tuple[int, int], zoom: float) -> None:
    """Also for a turned view, beyond the edges, where a corner is NaN, and where pixels are larger."""
    random = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (*size, 3), dtype=torch.uint8, generator=random)
    along = torch.arange(65, dtype=torch.float64) / zoom
    x, y = torch.meshgrid(along, along, indexing="xy")
    turn = math.radians(7)
    corners = (
        torch.stack([math.cos(turn) * x - math.sin(turn) * y, math.sin(turn) * x + math.cos(turn) * y], dim=-1) - 3
    )
    corners[-3:, -5:] = math.nan
    found = view(image, corners)
    origin, table = torch.tensor([[20.0, 7]], dtype=torch.float64), sums(image)
    assert torch.equal(found, area_means(table, origin, (corners - origin)[None])[0])
    rounded = area_means(table, origin.float(), (corners - origin)[None].float())[0]
    assert (found != rounded).float().mean() < 1e-3
    assert (found.int() - rounded.int()).abs().max() <= 1
    assert (found[-2:, -4:] == GREY).all()
    assert (found != GREY).any()
