"""A folder of own images as a source: exact where it must be, cached, and never served stale."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from phd_exp.data import folder as folder_module
from phd_exp.data.folder import FolderSource
from phd_exp.data.sources import RenderedSource, blocks
from phd_exp.geometry import projected
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.detections import DetectionLine
from phd_exp.records.errors import DatasetError
from phd_exp.records.own_images import DetectionFolder
from phd_exp.records.spec import DatasetSpec

BOXED: dict[str, Any] = {"file_name": "wide.jpg", "fx": 300.0, "fy": 320.0, "cx": 70.0, "cy": 40.0, "z": 2.0}


@pytest.fixture
def photos(tmp_path: Path) -> DetectionFolder:
    """Three detections in two images for training, one for testing; two sensors, neither square."""
    draw = np.random.default_rng(0)
    lines = {
        "train": [
            BOXED | {"x": 0.1, "y": 0.0, "box": [60, 20, 120, 70]},
            BOXED | {"x": -0.4, "y": 0.1, "box": [-10, 30, 30, 90]},
            {"file_name": "deep/tall.png", "f": 500, "x": 0, "y": 0, "z": 6.0},
        ],
        "test": [{"file_name": "tall.png", "f": 500, "x": 0.1, "y": 0.1, "z": 5.0, "visibility": 0.5}],
    }
    folder = DetectionFolder(tmp_path / "photos")
    for split, (name, size) in [
        ("train", ("wide.jpg", (160, 90))),
        ("train", ("deep/tall.png", (90, 160))),
        ("test", ("tall.png", (90, 160))),
    ]:
        file = folder.root / split / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(draw.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)).save(file)
    for split, rows in lines.items():
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (folder.root / split / "metadata.jsonl").write_text(text)  # type: ignore[arg-type]
    return folder


def source(folder: DetectionFolder, side: int = 48) -> FolderSource:
    return FolderSource(folder, None, 0, None, side)


def images(folder: DetectionFolder) -> np.ndarray:
    return source(folder).samples("train").image.numpy().copy()


def test_a_rendered_data_set_read_as_a_folder_is_itself(folder: DatasetFolder, spec: DatasetSpec) -> None:
    """Square images whole: the virtual camera is the camera, and every pixel and label stays what it was."""
    for side in (64, 32):
        rendered = RenderedSource(folder, spec, {"train": 5, "held_out": 0, "test": 3}, side)
        own = source(DetectionFolder(folder.root), side)
        for split in ("train", "test"):
            here, there = own.samples(split), rendered.samples(split)  # type: ignore[arg-type]
            assert torch.equal(here.image, there.image)
            assert torch.equal(here.xyz, there.xyz)
            torch.testing.assert_close(here.f, there.f, rtol=1e-7, atol=0)
            assert here.S == there.S
        assert all(np.array_equal(crop.camera.R, np.eye(3)) for crop in own.crops["train"])
    assert own.known("test").keys() <= rendered.known("test").keys()


def test_samples_are_in_the_frame_of_their_virtual_cameras(photos: DetectionFolder) -> None:
    own = source(photos)
    batch = own.samples("train")
    assert batch.image.shape == (3, 48, 48, 3)
    assert batch.row.tolist() == [0, 1, 2]
    for crop, xyz in zip(own.crops["train"], batch.xyz, strict=True):
        real = crop.camera.to_real(xyz.double().numpy())
        np.testing.assert_allclose(real, crop.detection.position, rtol=1e-6, atol=1e-6)
    assert (projected(batch.xyz, batch.camera)[:1].abs() < 1).all()  # the first lies in its box


def test_what_is_known_is_what_the_lines_say(photos: DetectionFolder) -> None:
    own = source(photos)
    assert own.known("train").keys() == {"file_name", "f", "S", "block"}
    known = own.known("test")
    assert known.keys() == {"file_name", "f", "S", "visibility"}
    assert (known["file_name"], known["S"], known["visibility"]) == (["tall.png"], [48], [0.5])
    assert (own.count("train"), own.count("held_out"), own.count("test")) == (3, 0, 1)


def test_lines_of_a_track_a_scene_or_an_image_are_a_block() -> None:
    given = [
        ("a", 1, None),
        ("b", 1, 7),
        ("c", None, 7),
        ("d", None, 7),
        ("e", None, None),
        ("e", None, None),
        ("f", 0, 1),
    ]
    lines = [DetectionLine(file_name=file, f=500, track=track, scene=scene) for file, track, scene in given]
    assert blocks(lines) == {"block": [0, 0, 1, 1, 2, 2, 3]}
    assert blocks(lines[4:5]) == {}


@pytest.mark.parametrize(("n_train", "n_held_out", "counts"), [(None, 1, (2, 1)), (1, 1, (1, 1)), (1, 2, (1, 2))])
def test_what_is_held_out_follows_what_is_trained_on(
    photos: DetectionFolder, n_train: int | None, n_held_out: int, counts: tuple[int, int]
) -> None:
    own, whole = FolderSource(photos, n_train, n_held_out, None, 48), source(photos)
    assert (own.count("train"), own.count("held_out")) == counts
    there = whole.samples("train").select(torch.arange(counts[0], sum(counts)))
    held_out = own.samples("held_out")
    assert torch.equal(held_out.image, there.image)
    assert torch.equal(held_out.xyz, there.xyz)
    ratio = (own.samples("train").xyz[:, 2] / own.samples("train").f).double()
    assert own.depth.mu_z0 == pytest.approx(math.sqrt(ratio.max() * ratio.min())), "of those trained on alone"


def test_decodes_each_image_once(photos: DetectionFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = []
    read = folder_module.read_image
    monkeypatch.setattr(
        folder_module, "read_image", lambda file, content: decoded.append(file.name) or read(file, content)
    )
    first = images(photos)
    assert sorted(decoded) == ["tall.png", "wide.jpg"]
    np.testing.assert_array_equal(images(photos), first)
    assert len(decoded) == 2


def change_line(photos: DetectionFolder, **changes: Any) -> None:
    path = photos.root / "train/metadata.jsonl"
    first, *others = path.read_text().splitlines()
    path.write_text("\n".join([json.dumps(json.loads(first) | changes), *others]) + "\n")


@pytest.mark.parametrize("key", ["box", "fx", "cy"])
def test_a_changed_line_is_never_served_the_old_crop(photos: DetectionFolder, key: str) -> None:
    before = images(photos)
    changes = {"box": [70, 20, 130, 70], "fx": 250.0, "cy": 10.0}
    change_line(photos, **{key: changes[key], **({"cx": 0.0} if key == "cy" else {})})
    after = images(photos)
    assert not np.array_equal(after[0], before[0])
    np.testing.assert_array_equal(after[2], before[2])


def test_a_camera_file_gives_the_lens_and_a_changed_one_new_crops(photos: DetectionFolder) -> None:
    """The label of a position is its place in the view, and a position that the lens cannot show is refused."""
    numbers = {
        "K": [300, 0, 69.5, 0, 320, 39.5, 0, 0, 1],
        "width": 160,
        "height": 90,
        "distortion_model": "equidistant",
    }
    line = {"fx": None, "fy": None, "cx": None, "cy": None, "camera": "lens.yaml"}
    before = images(photos)
    change_line(photos, **line)
    crops = []
    for k1 in (0.0, 0.3):
        (photos.root / "train" / "lens.yaml").write_text(json.dumps(numbers | {"D": [k1, 0, 0, 0]}))
        crops.append(images(photos))
        crop = source(photos).crops["train"][0]
        np.testing.assert_allclose(crop.camera.to_real(crop.xyz), [0.1, 0.0, 2.0], atol=1e-12)
        angle = math.atan(0.1 / 2)
        place = [70 + 300 * angle * (1 + k1 * angle**2), 40]
        np.testing.assert_allclose(crop.camera.real_pixels(crop.xyz[:2] / crop.xyz[2]), place, atol=1e-9)
    assert not np.array_equal(crops[0][0], before[0])
    assert not np.array_equal(crops[0][0], crops[1][0])
    np.testing.assert_array_equal(crops[1][1:], before[1:])
    change_line(photos, z=-2.0)
    with pytest.raises(
        DatasetError, match=r"line 1: the position \[0.1, 0.0, -2.0\] is far outside the image of 160 x 90"
    ):
        source(photos)


def test_a_changed_image_of_the_same_name_and_time_is_never_served_from_the_cache(photos: DetectionFolder) -> None:
    import os

    before, file = images(photos), photos.root / "train" / "deep" / "tall.png"
    time = file.stat().st_mtime_ns
    Image.new("RGB", (90, 160), (9, 9, 9)).save(file)
    os.utime(file, ns=(time, time))
    after = images(photos)
    np.testing.assert_array_equal(after[:2], before[:2])
    assert (after[2, 24] == 9).sum() > (before[2, 24] == 9).sum()


def cut_off(photos: DetectionFolder) -> None:
    file = photos.root / "train" / "wide.jpg"
    file.write_bytes(file.read_bytes()[:1000])


BAD: list[tuple[Callable[[DetectionFolder], None], str]] = [
    (lambda photos: change_line(photos, box=[200, 20, 250, 70]), "line 1: box=.* outside the image of 160 x 90"),
    (lambda photos: change_line(photos, file_name="no.jpg"), "line 1: .*no.jpg: cannot be read"),
    (lambda photos: (photos.root / "train" / "wide.jpg").write_bytes(b""), "wide.jpg: cannot be read as an im"),
    (lambda photos: change_line(photos, box=[140, 60, 160, 90], fx=40.0, fy=40.0, x=-20.0), "position .* 90 degrees"),
    (lambda photos: change_line(photos, fx=25.0, fy=25.0, box=[100, 10, 400, 60]), "line 1: box=.* 90 degrees or"),
    (lambda photos: change_line(photos, fx=18.0, fy=18.0), "line 1: .*18 x 18 pixels.* 150; f in millimetres"),
    (cut_off, r"wide\.jpg: cannot be read as an image"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "said"), BAD, ids=[said for _, said in BAD])
def test_what_cannot_be_a_sample_is_one_line_and_leaves_no_cache(
    photos: DetectionFolder, spoil: Callable, said: str
) -> None:
    spoil(photos)
    with pytest.raises(DatasetError, match=said) as caught:
        images(photos)
    assert "\n" not in str(caught.value)
    assert not list(photos.cache.glob("*.npy"))
