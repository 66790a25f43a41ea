"""`verify` finds whatever was changed in a data set, and nothing in one that was not."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder, Seal, sha256
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import verify as module
from phd_exp.rendering.verify import verify


@pytest.fixture
def copy(small: DatasetFolder, tmp_path: Path) -> DatasetFolder:
    return DatasetFolder(Path(shutil.copytree(small.root, tmp_path / "default")))


def complaints(folder: DatasetFolder, spec: DatasetSpec, rerender: int = 0) -> list[str]:
    with pytest.raises(DatasetError) as error:
        verify(folder, spec, rerender, seed=0)
    return str(error.value).splitlines()


def reseal(folder: DatasetFolder) -> None:
    """Make the manifest fit a changed metadata file, as somebody who knows the format could."""
    text = folder.metadata_path("train").read_bytes()
    seals = folder.manifest.splits | {"train": Seal(n=12, metadata_sha256=sha256(text))}
    folder.write_manifest(folder.manifest.model_copy(update={"splits": seals}))


def test_a_sound_data_set_is_sound(small: DatasetFolder, small_spec: DatasetSpec) -> None:
    assert verify(small, small_spec, rerender=3) == 16
    assert verify(small, small_spec, rerender=0) == 16


def test_samples_rendered_again_are_drawn_at_random(
    small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    said = set()
    for seed in range(3):
        verify(small, small_spec, rerender=2, seed=seed)
        said.add(capfd.readouterr().err)
    assert len(said) == 3


def test_a_changed_image(copy: DatasetFolder, small_spec: DatasetSpec) -> None:
    path = copy.image_path("train", 3)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    (line,) = complaints(copy, small_spec)
    assert line == f"{path}: its checksum is not the recorded one; delete it, and `render` makes it again"


def test_every_missing_and_every_strange_image_is_named(copy: DatasetFolder, small_spec: DatasetSpec) -> None:
    copy.image_path("train", 1).unlink()
    copy.image_path("test", 2).unlink()
    shutil.copy(copy.image_path("train", 0), copy.image_path("train", 99))
    missing, stranger = [], []
    for line in complaints(copy, small_spec):
        (stranger if "names it" in line else missing).append(line)
    assert ["000001.png" in missing[0], "000002.png" in missing[1], len(missing)] == [True, True, 2]
    assert ["000099.png" in stranger[0], len(stranger)] == [True, 1]


@pytest.mark.parametrize("change", ["cut", "shuffled", "gone", "value"])
def test_changed_metadata(copy: DatasetFolder, small_spec: DatasetSpec, change: str) -> None:
    path = copy.metadata_path("train")
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    if change == "gone":
        path.unlink()
    else:
        new = {"cut": text[:-20], "shuffled": "".join(lines[::-1]), "value": text.replace("rubber", "metal")}
        path.write_text(new[change])
    assert str(path) in complaints(copy, small_spec)[0]


def test_a_label_changed_by_somebody_who_knows_the_format(
    copy: DatasetFolder, small_spec: DatasetSpec
) -> None:
    """Checksums fit; rendering the samples again does not."""
    path = copy.metadata_path("train")
    records = [
        record.model_copy(update={"x": record.x + 0.01}) if record.index == 5 else record
        for record in copy.records("train")
    ]
    path.write_text("".join(record.model_dump_json() + "\n" for record in records))
    reseal(copy)
    assert verify(copy, small_spec, rerender=0) == 16
    (line,) = complaints(copy, small_spec, rerender=16)
    assert "000005.png: recorded x=" in line


def test_an_image_changed_by_somebody_who_knows_the_format(
    copy: DatasetFolder, small_spec: DatasetSpec
) -> None:
    image = copy.image_path("train", 5)
    Image.new("RGB", (56, 56), "red").save(image)
    records = [
        record.model_copy(update={"sha256": sha256(image.read_bytes())}) if record.index == 5 else record
        for record in copy.records("train")
    ]
    copy.metadata_path("train").write_text("".join(record.model_dump_json() + "\n" for record in records))
    reseal(copy)
    (line,) = complaints(copy, small_spec, rerender=16)
    assert "000005.png: rendering it again gives another image" in line


@pytest.mark.parametrize(
    ("content", "expected"), [(b"GIF89a", "cannot be decoded"), (None, "8 x 8 pixels, 56 x 56 recorded")]
)
def test_an_image_that_is_none(
    copy: DatasetFolder, small_spec: DatasetSpec, content: bytes | None, expected: str
) -> None:
    image = copy.image_path("train", 0)
    if content is None:
        Image.new("RGB", (8, 8)).save(image)
    else:
        image.write_bytes(content)
    records = copy.records("train")
    records[0] = records[0].model_copy(update={"sha256": sha256(image.read_bytes())})
    copy.metadata_path("train").write_text("".join(record.model_dump_json() + "\n" for record in records))
    reseal(copy)
    (line,) = complaints(copy, small_spec)
    assert expected in line


def test_another_data_set_and_none_are_refused(
    small: DatasetFolder, make_spec: Callable[..., DatasetSpec], tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match="sensor_size=56, but sensor_size=224 is asked for"):
        verify(small, make_spec(), rerender=0)
    with pytest.raises(DatasetError, match="no data set here"):
        verify(DatasetFolder(tmp_path), make_spec(), rerender=0)


def test_images_of_another_make_cannot_be_compared(copy: DatasetFolder, small_spec: DatasetSpec) -> None:
    copy.write_manifest(copy.manifest.model_copy(update={"generator": 1}))
    with pytest.raises(DatasetError, match=r"made by generator 1 .*; verify files alone by rerender=0"):
        verify(copy, small_spec, rerender=1)
    assert verify(copy, small_spec, rerender=0) == 16


def test_without_blender_files_can_be_verified(
    small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise RenderError("no bpy")

    monkeypatch.setattr(module, "require_bpy", missing)
    assert verify(small, small_spec, rerender=0) == 16
    with pytest.raises(RenderError, match="no bpy"):
        verify(small, small_spec, rerender=1)
