"""Images decoded once: exact, found again, and never taken for others."""

import numpy as np
import pytest
from PIL import Image

from phd_exp.data import images
from phd_exp.data.images import cached_images
from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.errors import DatasetError

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


def test_shrinking_averages_areas(folder: DatasetFolder) -> None:
    array = cached_images(folder, "train", folder.records("train"), SIDE // 2)
    means = picture(folder, 0).reshape(SIDE // 2, 2, SIDE // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(array[0] - means).max() <= 1  # rounded twice: along rows, then along columns


def test_decodes_once(folder: DatasetFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    first = cached_images(folder, "train", folder.records("train"), 32)
    monkeypatch.setattr(images, "decode", lambda *_: pytest.fail("decoded again"))
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


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda file: file.unlink(), "cannot be read"),
        (lambda file: file.write_bytes(b""), "checksum"),
        (lambda file: file.write_bytes(file.read_bytes()[:200]), "checksum"),
    ],
    ids=["missing", "empty", "cut off"],
)
def test_a_damaged_image_is_one_line_and_leaves_no_cache(
    folder: DatasetFolder, damage: object, said: str
) -> None:
    damage(folder.image_path("train", 3))  # type: ignore[operator]
    with pytest.raises(DatasetError, match=rf"train/000003\.png: .*{said}.*render"):
        cached_images(folder, "train", folder.records("train"), 32)
    assert not list(folder.cache.glob("*.npy"))


def test_what_is_no_image_is_one_line(folder: DatasetFolder) -> None:
    record = folder.records("train")[0].model_copy(update={"sha256": sha256(b"no image")})
    file = folder.image_path("train", 0)
    file.write_bytes(b"no image")
    with pytest.raises(DatasetError, match="cannot be decoded"):
        images.decode(file, record, 32)


def test_two_processes_may_decode_at_once(folder: DatasetFolder) -> None:
    from concurrent.futures import ThreadPoolExecutor

    records = folder.records("train")
    with ThreadPoolExecutor(4) as pool:  # each call opens the lock file anew, as a process would
        arrays = list(pool.map(lambda _: cached_images(folder, "train", records, 32), range(8)))
    for array in arrays:
        np.testing.assert_array_equal(array, arrays[0])


def test_a_read_only_data_set_is_one_line(folder: DatasetFolder) -> None:
    folder.cache.write_text("in the way of the folder")
    with pytest.raises(DatasetError, match=r"\.cache: decoded images cannot be kept here"):
        cached_images(folder, "train", folder.records("train"), 32)
