"""Image formats: the pixels that they keep, and data sets in each of them; light from OpenEXR files."""

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.scenes import SampleRecord
from phd_exp.records.spec import ImageFormat
from phd_exp.rendering.pixels import encode, read_light
from tests.support.renders import MakeSpec, decoded, pixels

LOSSY: tuple[ImageFormat, ...] = ("webp", "jpeg")


@pytest.fixture(scope="module")
def pictures(centred: DatasetFolder) -> list[np.ndarray]:
    """Images (S, S, 3) of full size, as the path tracer leaves them."""
    return [decoded(centred.image_path("train", index).read_bytes()) for index in range(2)]


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Peak signal over noise, dB."""
    return float(10 * np.log10(255**2 / ((one.astype(float) - other) ** 2).mean()))


def test_png_keeps_every_pixel(pictures: list[np.ndarray], make_spec: MakeSpec) -> None:
    rng = np.random.default_rng(0)
    for picture in (*pictures, rng.integers(0, 256, (20, 20, 3), dtype=np.uint8)):
        for quality in (1, 95):  # is not its business
            assert (decoded(encode(picture, make_spec(image_quality=quality))) == picture).all()


@pytest.mark.parametrize(("image_format", "share", "least"), [("webp", 0.25, 40.0), ("jpeg", 0.67, 45.0)])
def test_lossy_formats_are_small_and_near(
    pictures: list[np.ndarray], make_spec: MakeSpec, image_format: ImageFormat, share: float, least: float
) -> None:
    """As configured: bytes against those of png, and the error in dB."""
    lossy = make_spec(image_format=image_format)
    for picture in pictures:
        content = encode(picture, lossy)
        assert len(content) < share * len(encode(picture, make_spec()))
        assert psnr(decoded(content), picture) > least


@pytest.mark.parametrize("image_format", LOSSY)
def test_quality_is_paid_in_bytes(pictures: list[np.ndarray], make_spec: MakeSpec, image_format: ImageFormat) -> None:
    for picture in pictures:
        contents = [encode(picture, make_spec(image_format=image_format, image_quality=q)) for q in (30, 60, 90, 100)]
        sizes, errors = [len(content) for content in contents], [psnr(decoded(c), picture) for c in contents]
        assert sizes == sorted(set(sizes))
        assert errors == sorted(set(errors))


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


@pytest.fixture
def light() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 50, (4, 5, 3)).astype("<f2").astype(float)


def written(light: np.ndarray) -> bytes:
    """An OpenEXR file as Blender writes it, but for the header, which is not read."""
    rows = b"".join(
        np.array([number, 6 * light.shape[1]], "<i4").tobytes() + row.T[::-1].astype("<f2").tobytes()
        for number, row in enumerate(light, start=7)
    )
    return b"\x76\x2f\x31\x01" + b"header and offsets" + rows


def test_light_comes_back_from_a_file(light: np.ndarray) -> None:
    assert (read_light(written(light), 4, 5) == light).all()


@pytest.mark.parametrize(
    ("content", "size"),
    [
        (None, (4, 4)),
        (None, (5, 4)),
        (None, (400, 500)),
        (b"BM nonsense", (4, 5)),
        (b"\x76\x2f\x31\x01" + bytes(500), (4, 5)),
    ],
)
def test_a_file_of_another_size_or_kind_is_refused(
    light: np.ndarray, content: bytes | None, size: tuple[int, int]
) -> None:
    with pytest.raises(ValueError, match=f"OpenEXR file.*{size[0]}|OpenEXR file of {size[1]}"):
        read_light(written(light) if content is None else content, *size)


@pytest.fixture(params=["small", "small_webp"])
def folder(request: pytest.FixtureRequest) -> DatasetFolder:
    """Two splits, as PNG and as WebP."""
    found = request.getfixturevalue(request.param)
    assert isinstance(found, DatasetFolder)
    return found


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Hugging Face `datasets`, which reads these variables once, on import."""
    for name in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE", "HF_HUB_DISABLE_TELEMETRY"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    return importlib.import_module("datasets")


def as_read(record: SampleRecord) -> dict[str, object]:
    """The JSON of a record without the name of its image."""
    values: dict[str, object] = json.loads(record.model_dump_json())
    del values["file_name"]
    return values


def test_hugging_face_reads_it(folder: DatasetFolder, datasets: ModuleType, tmp_path: Path) -> None:
    data = datasets.load_dataset("imagefolder", data_dir=str(folder.root), cache_dir=str(tmp_path / "cache"))
    assert set(data) == set(SPLITS)
    for split in SPLITS:
        records = folder.records(split)
        assert data[split].num_rows == len(records) > 0
        assert set(data[split].column_names) == {"image", *as_read(records[0])}
        for row, record in zip(data[split], records, strict=True):
            image = row.pop("image")
            assert (np.asarray(image) == pixels(folder, record)).all()
            assert row == as_read(record)
