"""Images decoded once: exact, found again, and never taken for others."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from phd_exp.data import images
from phd_exp.data.images import cached_images, shrunk
from phd_exp.records.dataset import DatasetFolder, mapped
from phd_exp.records.errors import DatasetError
from tests.support.disks import small_disk

SIDE, N = 64, 5


def picture(folder: DatasetFolder, index: int) -> np.ndarray:
    with Image.open(folder.image_path("train", index)) as image:
        return np.asarray(image)


def test_at_full_size_the_pixels_are_the_files(folder: DatasetFolder) -> None:
    array = cached_images(folder, "train", folder.records("train"), SIDE)
    assert array.shape == (N, SIDE, SIDE, 3)
    assert array.dtype == np.uint8
    for index in range(N):
        np.testing.assert_array_equal(array[index], picture(folder, index))


def area_means(image: np.ndarray, side: int) -> np.ndarray:
    """The mean of each cell of a side x side grid over an image whose pixels are unit squares, in float64."""
    for axis in (0, 1):
        n = image.shape[axis]
        edges, left = np.arange(side + 1) * n / side, np.arange(n)
        overlap = np.minimum(edges[1:, None], left + 1) - np.maximum(edges[:-1, None], left)
        image = np.moveaxis(np.tensordot(overlap.clip(0) * side / n, image, (1, axis)), 0, axis)
    return image


SIZES = [(224, 224, 64), (224, 224, 112), (301, 220, 64), (100, 37, 33), (97, 97, 96), (40, 30, 64), (1, 5000, 7)]


@pytest.mark.parametrize(("height", "width", "side"), SIZES)
def test_shrinking_is_the_mean_of_areas_and_commutes_with_mirrors(height: int, width: int, side: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    small = shrunk(noise, side)
    assert np.abs(small - area_means(noise, side)).max() <= 0.5 + 1e-9
    for mirrored in (np.flipud, np.fliplr):
        np.testing.assert_array_equal(shrunk(mirrored(noise), side), mirrored(small))
    np.testing.assert_array_equal(shrunk(noise.swapaxes(0, 1), side), small.swapaxes(0, 1))


@pytest.mark.parametrize("stripe", [1, 1000, 20_000])
def test_stripes_change_nothing(monkeypatch: pytest.MonkeyPatch, stripe: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (150, 90, 3), dtype=np.uint8)
    whole = shrunk(noise, 64)
    monkeypatch.setattr(images, "_LARGEST_STRIPE", stripe)
    np.testing.assert_array_equal(shrunk(noise, 64), whole)


def test_decodes_once(folder: DatasetFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    first = cached_images(folder, "train", folder.records("train"), 32)
    monkeypatch.setattr(images, "recorded_image", lambda *_: pytest.fail("decoded again"))
    np.testing.assert_array_equal(cached_images(folder, "train", folder.records("train"), 32), first)


def test_other_images_are_never_taken_for_these(folder: DatasetFolder) -> None:
    before = cached_images(folder, "train", folder.records("train"), 32)
    records = folder.records("train")[::-1]
    after = cached_images(folder, "train", records, 32)
    np.testing.assert_array_equal(after, before[::-1])


def test_a_broken_cache_is_made_anew(folder: DatasetFolder) -> None:
    before = np.array(cached_images(folder, "train", folder.records("train"), 32))
    for file in folder.cache.glob("*.json"):
        file.write_text("{")
    np.testing.assert_array_equal(cached_images(folder, "train", folder.records("train"), 32), before)


def test_writing_into_the_array_leaves_the_file_alone(folder: DatasetFolder) -> None:
    array = cached_images(folder, "train", folder.records("train"), SIDE)
    before = np.array(array)
    array[:] = 0
    np.testing.assert_array_equal(cached_images(folder, "train", folder.records("train"), SIDE), before)


def test_images_that_exceed_the_memory_are_read_where_they_are(tmp_path: Path) -> None:
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    n, file = 4 * memory // (SIDE * SIDE * 3), tmp_path / "images.npy"
    sparse = np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=(n, SIDE, SIDE, 3))
    sparse[-1] = 7
    sparse.flush()
    images = torch.from_numpy(mapped(file, sparse.shape)).index_select(0, torch.tensor([0, n - 1]))
    assert images.flatten(1).amax(1).tolist() == [0, 7]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda file: file.unlink(), "cannot be read"),
        (lambda file: file.write_bytes(b""), "checksum"),
        (lambda file: file.write_bytes(file.read_bytes()[:200]), "checksum"),
    ],
    ids=["missing", "empty", "cut off"],
)
def test_a_damaged_image_is_one_line_and_leaves_no_cache(folder: DatasetFolder, damage: object, said: str) -> None:
    damage(folder.image_path("train", 3))  # type: ignore[operator]
    with pytest.raises(DatasetError, match=rf"train/000003\.png: .*{said}.*render"):
        cached_images(folder, "train", folder.records("train"), 32)
    assert not list(folder.cache.glob("*.npy"))


def test_images_of_a_read_only_data_set_are_decoded_into_memory(
    folder: DatasetFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = cached_images(folder, "train", folder.records("train"), 32)
    assert capsys.readouterr().err == ""
    shutil.rmtree(folder.cache)
    folder.cache.write_text("in the way of the folder")
    found = cached_images(folder, "train", folder.records("train"), 32)
    np.testing.assert_array_equal(found, expected)
    (line,) = capsys.readouterr().err.splitlines()
    assert ".cache: decoded images cannot be kept here (File exists); they are decoded into memory" in line


def test_images_without_room_on_the_disk_are_decoded_into_memory(
    folder: DatasetFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = cached_images(folder, "train", folder.records("train"), 32)
    shutil.rmtree(folder.cache)
    with small_disk(folder.cache, 8) as disk:
        found = cached_images(folder, "train", folder.records("train"), 32)
        np.testing.assert_array_equal(found, expected)
        assert "decoded images cannot be kept here (No space left on device)" in capsys.readouterr().err
        assert [file.name for file in disk.iterdir()] == ["decoding.lock"]
