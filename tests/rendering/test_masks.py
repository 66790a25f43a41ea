"""Masks and clearings next to the images: what they show, and when they are drawn."""

import threading
from pathlib import Path

import numpy as np
import pytest

from phd_exp.records import dataset
from phd_exp.records.dataset import CELLS, DatasetFolder
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.files import write_atomic
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import masks
from phd_exp.rendering.finished import verify
from phd_exp.rendering.masks import ensure_drawn, mask
from phd_exp.rendering.rays import NOTHING, cylinder_mask, trace_pixels
from phd_exp.rendering.render import ensure_rendered
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.sealing import begin
from phd_exp.rendering.triangles import NO_MESHES
from tests.support.renders import N_TEST, N_TRAIN, MakeSpec, described


@pytest.fixture
def old(folder: DatasetFolder, small_spec: DatasetSpec, copied: None) -> DatasetFolder:
    """A data set as earlier versions left it, without masks."""
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST)
    (folder.root / "masks.npy").unlink()
    return folder


@pytest.mark.parametrize("variant", ["default", "occl_scale"])
def test_a_cell_is_the_share_of_its_pixels_that_show_the_object(variant: str, make_spec: MakeSpec) -> None:
    spec = make_spec(variant, sensor_size=224)
    for index in range(20):
        scene = sample_scene(spec, "train", index)
        hits = trace_pixels(scene)
        found = mask(described(spec, "train", index), NO_MESHES) / 255
        share = cylinder_mask(hits).reshape(CELLS, 8, CELLS, 8).mean((1, 3))
        assert np.abs(found - share).max() < 0.2  # of 16 rays and 64 pixels
        assert found.sum() == pytest.approx(share.sum(), rel=0.05, abs=0.3)


def test_each_image_has_its_mask_and_each_of_a_mesh_its_clearing(of_mesh: MakeSpec, tmp_path: Path) -> None:
    spec = of_mesh(distractors=1, sensor_size=60, f_range=(343.0, 571.0))
    folder, behind = (DatasetFolder(tmp_path / one.variant) for one in (spec, spec.without_objects))
    ensure_rendered(folder, spec, 2, 1, workers=1)
    ensure_rendered(behind, spec.without_objects, 2, 0, workers=1)
    assert not list(behind.root.glob("*.npy"))
    meshes = masks.meshes_of(spec)
    cells, bits = folder.drawn("masks.npy", 2), folder.drawn("clearings.npy", 2)
    for record, shares, clear in zip(folder.records("train"), cells, bits, strict=True):
        np.testing.assert_array_equal(shares, mask(record, meshes))
        pixels = np.unpackbits(clear, axis=-1, count=record.S)
        np.testing.assert_array_equal(pixels, trace_pixels(record.as_scene, meshes).first == NOTHING)


def test_an_older_data_set_gets_them_once_and_is_verified_before_and_after(
    old: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert verify(old, small_spec, rerender=0) == N_TRAIN + N_TEST
    ensure_rendered(old, small_spec, 3, 0)
    np.testing.assert_array_equal(old.drawn("masks.npy", N_TRAIN), small.drawn("masks.npy", N_TRAIN))
    assert verify(old, small_spec, rerender=0) == N_TRAIN + N_TEST
    monkeypatch.setattr(masks, "write_atomic", lambda *_: pytest.fail("drawn again"))
    ensure_rendered(old, small_spec, N_TRAIN, N_TEST)


def test_they_grow_with_the_images(folder: DatasetFolder, small_spec: DatasetSpec, copied: None) -> None:
    ensure_rendered(folder, small_spec, 0, 1)
    assert not (folder.root / "masks.npy").exists()
    for n in (3, N_TRAIN):
        ensure_rendered(folder, small_spec, n, 1)
        assert len(folder.drawn("masks.npy", n)) == n
    with pytest.raises(
        DatasetError, match=r"masks\.npy: .*holds uint8 \(12, 28, 28\); expected uint8 \(13, 28, 28\)"
    ):
        folder.drawn("masks.npy", N_TRAIN + 1)


def test_those_of_a_folder_that_cannot_be_written_stop_no_training_that_needs_none(
    old: DatasetFolder, small_spec: DatasetSpec
) -> None:
    (old.root / "masks.npy").mkdir()
    assert ensure_rendered(old, small_spec, N_TRAIN, N_TEST)
    with pytest.raises(RenderError, match=r"masks\.npy.*: cannot be written") as error:
        ensure_drawn(old, small_spec, N_TRAIN)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "content", [b"", b"no array", np.zeros((N_TRAIN, CELLS), np.uint8), np.zeros((N_TRAIN, CELLS, CELLS))]
)
def test_a_broken_array_is_drawn_anew(
    old: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, content: bytes | np.ndarray
) -> None:
    file = old.root / "masks.npy"
    file.write_bytes(content) if isinstance(content, bytes) else np.save(file, content)
    ensure_rendered(old, small_spec, N_TRAIN, N_TEST)
    np.testing.assert_array_equal(old.drawn("masks.npy", N_TRAIN), small.drawn("masks.npy", N_TRAIN))


def test_one_of_another_version_is_refused_and_drawn_anew(
    old: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as earlier:
        for module in (dataset, masks):
            earlier.setattr(module, "DRAWING", {"drawing": 0})
        earlier.setitem(masks.DRAW, "masks.npy", lambda *_: np.zeros((CELLS, CELLS), np.uint8))
        ensure_drawn(old, small_spec, N_TRAIN)
        assert not old.drawn("masks.npy", N_TRAIN).any()
    with pytest.raises(DatasetError, match=r"masks\.npy: .*drawn by another version.*; write it by .* render data="):
        old.drawn("masks.npy", N_TRAIN)
    ensure_rendered(old, small_spec, N_TRAIN, N_TEST)
    assert old.drawn("masks.npy", N_TRAIN).any()
    (old.root / "masks.json").unlink()
    with pytest.raises(DatasetError, match=r"masks\.npy: .*drawn by another version"):
        old.drawn("masks.npy", N_TRAIN)


def test_one_of_several_processes_draws(
    old: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    monkeypatch.setattr(
        masks, "write_atomic", lambda file, data: (written.append(file.name), write_atomic(file, data))
    )
    racing = [threading.Thread(target=ensure_drawn, args=(old, small_spec, N_TRAIN)) for _ in range(4)]
    for thread in racing:
        thread.start()
    for thread in racing:
        thread.join()
    assert len(old.drawn("masks.npy", N_TRAIN)) == N_TRAIN
    assert written == ["masks.npy", "masks.json"]


def test_those_of_another_data_set_are_removed(old: DatasetFolder, small_spec: DatasetSpec) -> None:
    ensure_drawn(old, small_spec, N_TRAIN)
    old.manifest_path.unlink()
    begin(old, small_spec)
    assert not (old.root / "masks.npy").exists()
