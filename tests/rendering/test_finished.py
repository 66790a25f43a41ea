"""`verify` finds each change of a data set, and masks are the pixels that the records count."""

import io
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder, Seal, sha256
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import finished as module
from phd_exp.rendering.finished import require_elsewhere, verify
from phd_exp.rendering.masks import write_masks
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from tests.support.renders import N_TEST, N_TRAIN, MakeSpec


@pytest.fixture
def copy(small: DatasetFolder, tmp_path: Path) -> DatasetFolder:
    return DatasetFolder(Path(shutil.copytree(small.root, tmp_path / "default")))


def complaints(folder: DatasetFolder, spec: DatasetSpec, rerender: int = 0) -> list[str]:
    with pytest.raises(RenderError) as error:
        verify(folder, spec, rerender, seed=0)
    return str(error.value).splitlines()


def change(folder: DatasetFolder, index: int, content: bytes | None = None, **changes: float) -> None:
    """Change a record, and its image, and make the checksums fit, as an expert could."""
    image = folder.image_path("train", index)
    if content is not None:
        image.write_bytes(content)
    changed = {"sha256": sha256(image.read_bytes())} | changes
    lines = [
        record.model_copy(update=changed if record.index == index else {}).model_dump_json() + "\n"
        for record in folder.records("train")
    ]
    folder.metadata_path("train").write_text("".join(lines))
    seal = Seal(n=N_TRAIN, metadata_sha256=sha256("".join(lines).encode()))
    manifest = folder.manifest
    folder.write_manifest(manifest.model_copy(update={"splits": manifest.splits | {"train": seal}}))


def png(side: int) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (side, side), "red").save(stream, "png")
    return stream.getvalue()


def test_samples_rendered_again_are_drawn_at_random_and_the_same(
    small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    said = set()
    for seed in range(3):
        assert verify(small, small_spec, rerender=2, seed=seed) == N_TRAIN + N_TEST
        said.add(capfd.readouterr().err)
    assert len(said) == 3


def torn(folder: DatasetFolder) -> None:
    path = folder.image_path("train", 3)
    path.write_bytes(path.read_bytes()[:-1] + b"x")


def lost(folder: DatasetFolder) -> None:
    folder.image_path("train", 1).unlink()
    shutil.copy(folder.image_path("train", 0), folder.image_path("train", 99))


def rewritten(change: Callable[[str], str]) -> Callable[[DatasetFolder], None]:
    def rewrite(folder: DatasetFolder) -> None:
        path = folder.metadata_path("train")
        path.write_text(change(path.read_text()))

    return rewrite


FAULTS: dict[str, tuple[Callable[[DatasetFolder], None], list[str]]] = {
    "torn": (torn, [r"000003\.png: its checksum is not the recorded one; delete it, and `render` makes it again"]),
    "lost": (lost, [r"000099\.png: no line of metadata", r"000001\.png: cannot be read .*; `render` makes it again"]),
    "kind": (lambda folder: change(folder, 0, b"GIF89a"), [r"000000\.png: .*cannot be read as an image"]),
    "size": (lambda folder: change(folder, 0, png(8)), [r"000000\.png: .*\(8, 8\) pixels of RGB; expected 56 x 56"]),
    "gone": (lambda folder: folder.metadata_path("train").unlink(), [r"metadata\.jsonl: missing"]),
    "value": (rewritten(lambda text: text.replace("rubber", "metal")), [r"metadata\.jsonl: its checksum"]),
    "cut": (rewritten(lambda text: text[:-20]), [r"metadata\.jsonl: its checksum", "line 12: not a valid record"]),
}


@pytest.mark.parametrize(("damage", "expected"), FAULTS.values(), ids=FAULTS)
def test_each_fault_is_named(
    copy: DatasetFolder, small_spec: DatasetSpec, damage: Callable[[DatasetFolder], None], expected: list[str]
) -> None:
    damage(copy)
    lines = complaints(copy, small_spec)
    assert len(lines) == len(expected)
    for line, words in zip(lines, expected, strict=True):
        assert re.search(words, line)


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"x": 0.5}, "recorded x=0.5"), ({"content": png(56)}, "rendering it again gives another image")],
    ids=["label", "image"],
)
def test_a_change_with_fitting_checksums_shows_when_rendered_again(
    copy: DatasetFolder, small_spec: DatasetSpec, changes: dict[str, Any], said: str
) -> None:
    z = math.nextafter(copy.records("train")[5].z, 9)  # a rounding error is no change
    change(copy, 5, z=z, **changes)
    assert verify(copy, small_spec, rerender=0) == N_TRAIN + N_TEST
    (line,) = complaints(copy, small_spec, rerender=N_TRAIN + N_TEST)
    assert f"000005.png: {said}" in line


def test_another_data_set_and_none_are_refused(small: DatasetFolder, make_spec: MakeSpec, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"f_range=\(300.0, 500.0\), but f_range=\(1200.0, 2000.0\) is asked for"):
        verify(small, make_spec(), rerender=0)
    with pytest.raises(DatasetError, match="no data set here"):
        verify(DatasetFolder(tmp_path), make_spec(), rerender=0)


def test_images_of_another_make_cannot_be_compared(copy: DatasetFolder, small_spec: DatasetSpec) -> None:
    copy.write_manifest(copy.manifest.model_copy(update={"generator": 1}))
    with pytest.raises(DatasetError, match=r"made by generator 1 .*; verify files alone by rerender=0"):
        verify(copy, small_spec, rerender=1)
    assert verify(copy, small_spec, rerender=0) == N_TRAIN + N_TEST


def test_without_blender_files_can_be_verified(
    small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise RenderError("no bpy")

    monkeypatch.setattr(module, "require_bpy", missing)
    assert verify(small, small_spec, rerender=0) == N_TRAIN + N_TEST
    with pytest.raises(RenderError, match="no bpy"):
        verify(small, small_spec, rerender=1)


def test_a_mask_for_every_sample(rendered: DatasetFolder, tmp_path: Path) -> None:
    assert write_masks(rendered, tmp_path / "masks") == 7
    for record in rendered.records("train"):
        with Image.open(tmp_path / "masks" / "train" / record.file_name) as image:
            assert image.mode == "1"
            mask = np.asarray(image)
        hits = trace_pixels(record.as_scene)
        assert (mask == cylinder_mask(hits)).all()
        alone = np.isfinite(hits.depths[0]).sum()
        assert mask.sum() == pytest.approx(record.visibility * alone)
    assert (tmp_path / "masks" / "test" / "000000.png").exists()


def test_masks_that_cannot_be_written_are_one_line(small: DatasetFolder, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RenderError, match=r"masks=.*: lies in the data set itself"):
        require_elsewhere(small, masks=small.root / "train" / "masks")
    with pytest.raises(RenderError, match=r"cannot be written .* choose another masks=FOLDER"):
        write_masks(small, tmp_path / "file" / "masks")
    with pytest.raises(DatasetError, match="no data set here"):
        write_masks(DatasetFolder(tmp_path / "none"), tmp_path / "masks")
