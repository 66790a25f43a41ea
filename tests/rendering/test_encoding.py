"""What a format keeps of the pixels, and that a data set of any format is a data set."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.spec import DatasetSpec, ImageFormat
from phd_exp.rendering.pixels import encode
from phd_exp.rendering.render import ensure_rendered

MakeSpec = Callable[..., DatasetSpec]
LOSSY: tuple[ImageFormat, ...] = ("webp", "jpeg")


@pytest.fixture(scope="module")
def pictures(make_spec: MakeSpec, tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """Images (S, S, 3) of full size, as the path tracer leaves them."""
    folder = DatasetFolder(tmp_path_factory.mktemp("pictures") / "occl_scale")
    ensure_rendered(folder, make_spec("occl_scale"), n_train=3, n_test=0, workers=1)
    return [decoded(folder.image_path("train", index).read_bytes()) for index in range(3)]


def decoded(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as image:
        assert image.mode == "RGB"
        return np.asarray(image)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal over noise, dB."""
    return float(10 * np.log10(255**2 / ((one.astype(float) - other) ** 2).mean()))


def files(folder: DatasetFolder) -> dict[str, bytes]:
    found = (path for path in folder.root.rglob("*") if path.is_file() and folder.cache not in path.parents)
    return {str(path.relative_to(folder.root)): path.read_bytes() for path in found}


def test_png_keeps_every_pixel(pictures: list[np.ndarray], make_spec: MakeSpec) -> None:
    rng = np.random.default_rng(0)
    for pixels in (*pictures, rng.integers(0, 256, (20, 20, 3), dtype=np.uint8)):
        for quality in (1, 95):  # is not its business
            assert (decoded(encode(pixels, make_spec(image_quality=quality))) == pixels).all()


@pytest.mark.parametrize(("image_format", "share", "least"), [("webp", 0.25, 40.0), ("jpeg", 0.67, 45.0)])
def test_lossy_formats_are_small_and_near(
    pictures: list[np.ndarray], make_spec: MakeSpec, image_format: ImageFormat, share: float, least: float
) -> None:
    """As configured: bytes against those of png, and the error in dB."""
    lossy = make_spec(image_format=image_format)
    for pixels in pictures:
        content = encode(pixels, lossy)
        assert len(content) < share * len(encode(pixels, make_spec()))
        assert psnr(decoded(content), pixels) > least


@pytest.mark.parametrize("image_format", LOSSY)
def test_quality_is_paid_in_bytes(
    pictures: list[np.ndarray], make_spec: MakeSpec, image_format: ImageFormat
) -> None:
    for pixels in pictures:
        contents = [
            encode(pixels, make_spec(image_format=image_format, image_quality=q)) for q in (30, 60, 90, 100)
        ]
        sizes, errors = [len(content) for content in contents], [psnr(decoded(c), pixels) for c in contents]
        assert sizes == sorted(set(sizes))
        assert errors == sorted(set(errors))


@pytest.mark.parametrize("image_format", ["png", *LOSSY])
def test_the_same_pixels_are_the_same_bytes(
    pictures: list[np.ndarray], make_spec: MakeSpec, image_format: ImageFormat
) -> None:
    spec = make_spec(image_format=image_format)
    assert encode(pictures[0].copy(), spec) == encode(pictures[0], spec) != encode(pictures[1], spec)


def test_webp_files_hold_the_pixels_of_the_png_files(
    small: DatasetFolder, small_webp: DatasetFolder, small_spec: DatasetSpec
) -> None:
    spec = small_webp.manifest.spec
    assert spec.image_format == "webp"
    for split, n in zip(SPLITS, (5, 2), strict=True):
        assert small_webp.images(split) == {f"{index:06d}.webp" for index in range(n)}
        for record, reference in zip(small_webp.records(split), small.records(split, n), strict=True):
            pixels = decoded(small.image_path(split, record.index).read_bytes())
            assert small_webp.image_path(split, record.index, "webp").read_bytes() == encode(pixels, spec)
            same = {"file_name": record.file_name, "sha256": record.sha256}
            assert record == reference.model_copy(update=same) != reference


def test_the_data_module_reads_webp(small_webp: DatasetFolder) -> None:
    spec = small_webp.manifest.spec
    data = PositionData(
        RenderedSource(small_webp, spec, {"train": 5, "held_out": 0, "test": 2}, spec.sensor_size),
        batch_size=5,
        seed=0,
    )
    data.setup()
    for split in SPLITS:
        for record, image in zip(small_webp.records(split), data.samples[split].image.numpy(), strict=True):
            assert (image == decoded((small_webp.split_folder(split) / record.file_name).read_bytes())).all()


def test_a_webp_folder_is_resumed(small_webp: DatasetFolder, tmp_path: Path) -> None:
    """Grown, and mended where an image has gone, it has the bytes of one rendered at once."""
    spec, folder = small_webp.manifest.spec, DatasetFolder(tmp_path / "default")
    ensure_rendered(folder, spec, 3, 1, workers=1)
    first = folder.image_path("train", 0, "webp").stat().st_mtime_ns
    folder.image_path("train", 2, "webp").unlink()
    ensure_rendered(folder, spec, 5, 2, workers=1)
    assert folder.image_path("train", 0, "webp").stat().st_mtime_ns == first
    assert files(folder) == files(small_webp)


@pytest.mark.parametrize(("key", "value"), [("image_format", "webp"), ("image_quality", 90)])
def test_a_folder_keeps_its_format(small: DatasetFolder, key: str, value: object) -> None:
    before, spec = files(small), small.manifest.spec
    with pytest.raises(
        DatasetError, match=f"{key}={getattr(spec, key)}, but {key}={value} is asked for; move"
    ) as error:
        ensure_rendered(small, spec.model_copy(update={key: value}), 20, 4)
    assert "\n" not in str(error.value)
    assert files(small) == before
