"""Recordings of ROS 2: messages read by another library, images of recordings as those of files, and mistakes."""

import contextlib
import io
import json
import re
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.data.crops import read_image
from phd_exp.inference import answers
from phd_exp.records.errors import DatasetError
from phd_exp.records.messages import SECOND, UNKNOWN, typestore
from phd_exp.records.recordings import ENCODINGS, Recording
from phd_exp.records.runs import RunFolder
from tests.support.recordings import FRAME, Message, compressed, image, info, read, time_of, write
from tests.support.untrained import NOWHERE, read_lines

pytest.importorskip("rosbags", reason="recordings need the extra `ros`")
pytest.importorskip("mcap_ros2", reason="mcap-ros2-support reads and writes what rosbags has to agree with")

WIDTH, HEIGHT, N = 64, 48, 8
START = 1_700_000_000 * SECOND + 123_456_789  # ns
K = (90.0, 0, 30.0, 0, 95.0, 25.0, 0, 0, 1)
MODELS = {
    "plumb_bob": [-0.1, 0.01, 0.001, -0.002, 0.0],
    "rational_polynomial": [0.1, 0.02, 0.001, 0.002, 0.001, 0.05, 0.01, 0.001],
    "equidistant": [0.01, -0.002, 0.001, 0.0],
}
NEAR = {"rel": 1e-9, "abs": 1e-12}


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> str:
    return f"run={make(*NOWHERE).path}"


@pytest.fixture(autouse=True)
def unrounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """JSON lines have all digits, so that messages are held against them."""
    monkeypatch.setattr(answers, "DIGITS", 17)


def pictures(n: int = N) -> list[np.ndarray]:
    """A bright square that moves over noise, RGB."""
    draw = np.random.default_rng(0)
    found = [draw.integers(60, 120, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(n)]
    for k, one in enumerate(found):
        one[15:35, 10 + k : 30 + k] = 200, 120, 40
    return found


def png(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(array).save(stream, "png")
    return stream.getvalue()


def times(n: int = N) -> list[int]:
    """Times at unequal distances, ns."""
    return [START + round(k**1.5 * SECOND / 20) for k in range(n)]


def recorded(file: Path, *more: Message, n: int = N) -> Path:
    """A recording of PNG images with their camera."""
    messages = [info((WIDTH, HEIGHT), K, START)]
    messages += [compressed(png(one), "png", time) for one, time in zip(pictures(n), times(n), strict=True)]
    return write(file, [*messages, *more])


def covariance_of(pose: Any) -> np.ndarray:
    return np.reshape(pose.covariance, (6, 6))


def assert_located(pose: Any, mean: Any, covariance: Any) -> None:
    """A pose has this position with this covariance, and no known rotation."""
    place = pose.pose.position
    assert [place.x, place.y, place.z] == pytest.approx(mean, **NEAR)
    found = covariance_of(pose)
    assert found[:3, :3] == pytest.approx(np.array(covariance), **NEAR)
    assert (found[3:, 3:] == UNKNOWN * np.eye(3)).all()
    assert not found[:3, 3:].any()
    assert not found[3:, :3].any()


def written(file: Path) -> dict[str, list[Any]]:
    """Topic -> messages."""
    found: dict[str, list[Any]] = {}
    for topic, message in read(file):
        found.setdefault(topic, []).append(message)
    return found


def test_predictions_are_read_by_another_library(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    """Two objects in the first photograph; the boxes lie beside the axis, so that covariances are turned."""
    boxes = [[8, 12, 32, 38], [30, 5, 60, 40], [2, 2, 20, 20]]
    lines = []
    for number, box in enumerate(boxes):
        name = f"{max(number, 1)}.png"
        Image.fromarray(pictures()[number]).save(tmp_path / name)
        camera = {"fx": K[0], "fy": K[4], "cx": K[2] + 0.5, "cy": K[5] + 0.5}
        line = {"file_name": name, "box": box, "category_id": number, "score": 0.25 * number, **camera}
        lines.append(json.dumps(line))
    (tmp_path / "metadata.jsonl").write_text("\n".join(lines))
    outcome = phd_exp("predict", run, f"folder={tmp_path}", "out=new/a.mcap")
    assert (outcome.status, outcome.err) == (0, "")
    rows, found = read_lines(outcome.out), written(tmp_path / "new/a.mcap")
    arrays = found["/detections"]
    assert [len(one.detections) for one in arrays] == [2, 1]
    assert [time_of(one) for one in arrays] == [0, SECOND]
    objects = [one for array in arrays for one in array.detections]
    for row, one, position in zip(rows, objects, found["/position"], strict=True):
        (result,) = one.results
        assert_located(result.pose, row["mean"], row["covariance"])
        assert_located(position.pose, row["mean"], row["covariance"])
        assert (result.hypothesis.class_id, result.hypothesis.score) == (str(row["category_id"]), row["score"])
        assert one.header.frame_id == position.header.frame_id == "camera_optical_frame"
    assert [one.data for one in found["/camera/image_raw/compressed"]] == [
        (tmp_path / name).read_bytes() for name in ("1.png", "2.png")
    ]
    assert [list(one.k) for one in found["/camera/camera_info"]] == [pytest.approx(K, **NEAR)] * 2


@pytest.mark.parametrize("model", MODELS)
def test_what_is_written_is_read_as_the_same_photographs(
    phd_exp: Callable, run: str, tmp_path: Path, model: str
) -> None:
    (tmp_path / "photos").mkdir()
    for number, one in enumerate(pictures(2)):
        Image.fromarray(one).save(tmp_path / f"photos/{number}.{('png', 'bmp')[number]}")
    camera = {"image_width": WIDTH, "image_height": HEIGHT, "camera_matrix": {"rows": 3, "cols": 3, "data": K}}
    camera |= {"distortion_model": model, "distortion_coefficients": {"rows": 1, "cols": 1, "data": MODELS[model]}}
    camera["distortion_coefficients"]["cols"] = len(MODELS[model])
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    words = ("predict", run, "box=8,12,32,38")
    first = phd_exp(*words, "folder=photos", "camera=camera.json", "out=a.mcap")
    again = phd_exp(*words, "folder=a.mcap", "out=b.mcap")
    assert (first.status, again.status, again.err) == (0, 0, "")
    for one, other in zip(read_lines(first.out), read_lines(again.out), strict=True):
        assert other.pop("file_name") == f"{int(one.pop('file_name')[0])}.000000000"
        assert one == other
    assert str(written(tmp_path / "a.mcap")) == str(written(tmp_path / "b.mcap"))


def as_file(folder: Path, messages: list[Message]) -> Path:
    return write(folder / "a.mcap", messages)


def as_sqlite(folder: Path, messages: list[Message]) -> Path:
    """A rosbag2 folder with a database, which no library but rosbags writes here."""
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    source = as_file(folder, messages)
    with Reader(source) as reader, Writer(folder / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {
            one.topic: writer.add_connection(one.topic, one.msgtype, typestore=typestore())
            for one in reader.connections
        }
        for connection, time, data in reader.messages():
            writer.write(topics[connection.topic], time, data)
    source.unlink()
    return folder / "bag"


def as_early_file(folder: Path, messages: list[Message]) -> Path:
    """A database whose types have the names of the first releases of ROS 2."""
    (file,) = as_sqlite(folder, messages).glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE topics SET type = replace(type, '/msg/', '/')")
    return file


@pytest.mark.parametrize(
    ("encoding", "store"),
    [("mono8", as_file), ("rgb8", as_file), ("bgr8", as_file), ("bgr8", as_sqlite), ("png", as_early_file)],
)
def test_images_of_all_encodings_are_those_of_files(
    phd_exp: Callable, run: str, tmp_path: Path, encoding: str, store: Callable
) -> None:
    arrays = pictures(3) if encoding != "mono8" else [one[..., 0] for one in pictures(3)]
    made = [
        compressed(png(one), "png", time) if encoding == "png" else image(one, encoding, time)
        for one, time in zip(arrays, times(3), strict=True)
    ]
    source = store(tmp_path, [info((WIDTH, HEIGHT), K, START), *made])
    (tmp_path / "photos").mkdir()
    for number, one in enumerate(arrays):
        Image.fromarray(one).save(tmp_path / f"photos/{number}.png")
    words = ("predict", run, "box=8,12,32,38")
    expected = phd_exp(*words, "folder=photos", "fx=90", "fy=95", "cx=30.5", "cy=25.5")
    outcome = phd_exp(*words, f"folder={source}")
    assert (outcome.status, outcome.err) == (0, "")
    rows = read_lines(outcome.out)
    assert [row.pop("file_name") for row in rows] == [f"{time / SECOND:.0f}.{time % SECOND:09}" for time in times(3)]
    assert rows == [{key: row[key] for key in row if key != "file_name"} for row in read_lines(expected.out)]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_pixels_do_not_depend_on_their_encoding(tmp_path: Path, encoding: str) -> None:
    (picture,) = pictures(1)
    is_grey = encoding in ("mono8", "8UC1", "mono16")
    write(tmp_path / "a.mcap", [CAMERA, image(picture[..., 0] if is_grey else picture, encoding, START)])
    (found,) = Recording.of(tmp_path / "a.mcap", None, {})
    expected = np.repeat(picture[..., :1], 3, axis=2) if is_grey else picture
    np.testing.assert_array_equal(np.asarray(read_image(found.file, found.content)), expected)


def region(x: int, y: int, width: int, height: int) -> dict[str, Any]:
    return {"x_offset": x, "y_offset": y, "width": width, "height": height, "do_rectify": False}


SENSOR = ((256, 144), (400.0, 0, 120.0, 0, 410.0, 70.0, 0, 0, 1))
READ_OUT: dict[str, tuple[tuple[int, int], dict[str, Any], tuple[float, float, float, float]]] = {
    "nothing": ((256, 144), {}, (1, 1, 0, 0)),
    "binning": ((64, 48), {"binning_x": 4, "binning_y": 3}, (4, 3, 0, 0)),
    "a region": ((64, 48), {"roi": region(90, 40, 64, 48)}, (1, 1, 90, 40)),
    "a binned region": ((64, 48), {"roi": region(40, 20, 128, 96), "binning_x": 2, "binning_y": 2}, (2, 2, 40, 20)),
    "an own size": ((64, 48), {"roi": region(90, 40, 64, 48), "width": 64, "height": 48}, (1, 1, 90, 40)),
}
"""Size of the images, fields of `camera_info`, and what follows from its definition: binning and offset."""


@pytest.mark.parametrize("name", READ_OUT)
@pytest.mark.parametrize("is_compressed", [False, True], ids=["raw", "compressed"])
def test_a_camera_is_that_of_the_pixels_that_are_read_out(tmp_path: Path, name: str, is_compressed: bool) -> None:
    """A pixel covers a rectangle of those of the sensor: its corner lies at (offset + binning times the corner)."""
    (width, height), fields, (bin_x, bin_y, x, y) = READ_OUT[name]
    picture = np.full((height, width, 3), 90, np.uint8)
    shot = compressed(png(picture), "png", START) if is_compressed else image(picture, "rgb8", START)
    write(tmp_path / "a.mcap", [info(*SENSOR, START, **fields), shot])
    (found,) = Recording.of(tmp_path / "a.mcap", None, {})
    (fx, _, cx), (_, fy, cy), _ = found.optics(width, height)[0]
    xyz = np.array([0.3, -0.2, 2.0])
    on_sensor = 410 * xyz[1] / xyz[2] + 70.5
    assert bin_y * (cy + fy * xyz[1] / xyz[2]) + y == pytest.approx(on_sensor)
    assert bin_x * (cx + fx * xyz[0] / xyz[2]) + x == pytest.approx(400 * xyz[0] / xyz[2] + 120.5)


def test_a_path_has_the_times_of_the_recording(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap")
    outcome = phd_exp("track", run, "folder=a.mcap", "box=8,12,32,38", "stride=2", "lag=4", "out=b.mcap")
    assert (outcome.status, outcome.err) == (0, "")
    rows, found = read_lines(outcome.out), written(tmp_path / "b.mcap")
    assert [row["frame"] for row in rows] == list(range(0, N, 2))
    assert [row["time"] for row in rows] == [(time - START) / SECOND for time in times()[::2]]
    assert [time_of(one) for one in found["/detections"]] == times()[::2]
    assert len(found["/camera/image_raw/compressed"]) == len(rows)
    for row, array in zip(rows, found["/detections"], strict=True):
        assert array.header.frame_id == FRAME
        (one,) = array.detections
        assert_located(one.results[0].pose, row["mean"], row["covariance"])
        assert one.id == "a/0"


def test_fused_positions_are_in_the_world_with_the_cameras(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    turn, lines = [np.cos(0.1), 0.0, np.sin(0.1), 0.0], []
    for number, one in enumerate(pictures(4)):
        Image.fromarray(one).save(tmp_path / f"{number}.png")
        pose = {"rotation": turn if number % 2 else [1.0, 0, 0, 0], "translation": [0.1 * (number % 2), 0.0, 0.2]}
        line = {"file_name": f"{number}.png", "f": 90.0, "scene": number // 2, "time": 7.5 + number}
        lines.append(line | {"pose": pose})
    (tmp_path / "metadata.jsonl").write_text("\n".join(map(json.dumps, lines)))
    outcome = phd_exp("fuse", run, f"folder={tmp_path}", "out=fused.mcap")
    rows, found = read_lines(outcome.out), written(tmp_path / "fused.mcap")
    assert [row["status"] for row in rows] == ["fused", "fused"]
    for row, array, time in zip(rows, found["/detections"], (7.5, 9.5), strict=True):
        assert (array.header.frame_id, time_of(array)) == ("world", time * SECOND)
        (one,) = array.detections
        assert_located(one.results[0].pose, row["mean"], row["covariance"])
    assert {"/camera_1/camera_info", "/camera_2/image_raw/compressed"} < found.keys()
    (moved,) = found["/tf"][1].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("world", "camera_2_optical_frame")
    # the camera's centre has v_camera = R v_world + t = 0
    angle = 0.2
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    place, rotation = moved.transform.translation, moved.transform.rotation
    assert R @ [place.x, place.y, place.z] + [0.1, 0, 0.2] == pytest.approx(np.zeros(3), abs=1e-12)
    assert [rotation.x, rotation.y, rotation.z, rotation.w] == pytest.approx([0, -turn[2], 0, turn[0]], abs=1e-12)


def test_rectified_images_have_the_camera_p_and_no_lens(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    P = [80.0, 0, 31.5, 0, 0, 80.0, 23.5, 0, 0, 0, 1, 0]
    camera = info((WIDTH, HEIGHT), K, START, d=MODELS["plumb_bob"], p=P)
    write(tmp_path / "a.mcap", [camera, image(pictures(1)[0], "rgb8", START, "/front/image_rect")])
    Image.fromarray(pictures(1)[0]).save(tmp_path / "a.png")
    one, other = (phd_exp("predict", run, *words) for words in (["folder=a.mcap"], ["image=a.png", "f=80"]))
    assert read_lines(one.out)[0]["mean"] == read_lines(other.out)[0]["mean"]


def test_a_topic_selects_one_of_several_cameras(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    other = image(pictures(1)[0], "rgb8", START, "/rear/image")
    recorded(tmp_path / "a.mcap", other, info((WIDTH, HEIGHT), K, START, "/calibrated"), n=2)
    lines = {}
    for topic in ("/front/image_raw/compressed", "/rear/image,/calibrated"):
        outcome = phd_exp("predict", run, "folder=a.mcap", f"topic={topic}")
        lines[topic] = read_lines(outcome.out)
        assert outcome.status == 0, outcome.err
    assert [len(rows) for rows in lines.values()] == [2, 1]
    one, other = (rows[0]["mean"] for rows in lines.values())
    assert one == pytest.approx(other, rel=1e-5)  # float32, in batches of two and one


def damaged(file: Path, place: float = 0.5) -> None:
    content = bytearray(file.read_bytes())
    middle = int(place * len(content))
    content[middle : middle + 40] = bytes(255 - value for value in content[middle : middle + 40])
    file.write_bytes(content)


def late_info() -> Message:
    """Another camera, after five images."""
    return info((WIDTH, HEIGHT), [91.0, *K[1:]], times()[4] + 1)


SHOT, CAMERA = image(pictures(1)[0], "rgb8", START), info((WIDTH, HEIGHT), K, START)
NOT_CALIBRATED = info((WIDTH, HEIGHT), [0] * 9, START)
DEPTH = image(pictures(1)[0], "16UC1", START + 9)
EARLIER = {"header": {"stamp": {"sec": START // SECOND, "nanosec": 0}, "frame_id": ""}}
BACKWARDS = compressed(png(pictures(1)[0]), "png", times()[5] + 1)
BACKWARDS = BACKWARDS._replace(content=BACKWARDS.content | EARLIER)
SMALLER = compressed(png(pictures(1)[0][:20]), "png", times()[-1] + SECOND)
UNREADABLE = r"cannot be read as a recording of ROS 2 \("
SPOILED: dict[str, tuple[Callable[[Path], Any], str, int]] = {
    "no camera_info": (
        lambda file: write(file, [SHOT]),
        r"no camera_info of /front/image_raw: found none; expected /front/camera_info, .* or camera=FILE or f=", 0,
    ),
    "no images": (lambda file: write(file, [CAMERA]), r"has no images; expected a topic", 0),
    "not calibrated": (
        lambda file: write(file, [SHOT, NOT_CALIBRATED]),
        r"/front/camera_info: .*camera matrix: got .*; expected a calibrated camera, or camera=FILE", 0,
    ),
    "a camera that is binned already": (
        lambda file: write(file, [SHOT, info((WIDTH, HEIGHT), K, START, binning_x=2, binning_y=2)]),
        r"binning .2, 2. and region .0, 0, 0, 0. of .64, 48. make no images of .64, 48.; expected .* sensor", 0,
    ),
    "an encoding": (
        lambda file: write(file, [CAMERA, SHOT, DEPTH]),
        r"at 1700000000.123456798: got the encoding '16UC1'; expected mono8, .*, or a compressed image; convert", 1,
    ),
    "a Bayer pattern": (
        lambda file: write(file, [CAMERA, image(pictures(1)[0][..., 0], "bayer_rggb8", START)]),
        r"got the encoding 'bayer_rggb8'; expected .*; convert it with image_proc", 0,
    ),
    "a file that is no image": (
        lambda file: write(file, [CAMERA, compressed(b"h264", "h264", START)]),
        r"a.mcap/1700000000.123456789: cannot be read as an image .of another kind", 0,
    ),
    "times backwards": (
        lambda file: recorded(file, BACKWARDS),
        r"at 1700000000.000000000: time: got .* after .*; expected increasing times", 6,
    ),
    "a camera that changes": (lambda file: recorded(file, late_info()), r"the camera changes; expected one", 5),
    "another size": (lambda file: recorded(file, SMALLER), r"got 64 x 20 pixels; expected 64 x 48", N),
    "text": (lambda file: file.write_text("no recording"), UNREADABLE + ".*magic", 0),
    "an unprintable topic": (
        lambda file: write(file, [CAMERA, image(pictures(1)[0], "rgb8", START, "/a\nerror: b")]), r"/a error: b", 0
    ),
    "missing": (lambda file: None, UNREADABLE + "No such file or directory", 0),
}  # fmt: skip
"""What makes a recording, the line that refuses it, and the frames before."""


@pytest.mark.parametrize("name", SPOILED)
def test_a_bad_recording_is_refused_on_one_line(phd_exp: Callable, run: str, tmp_path: Path, name: str) -> None:
    spoil, said, kept = SPOILED[name]
    spoil(tmp_path / "a.mcap")
    outcome = phd_exp("track", run, "folder=a.mcap", "lag=4")
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: a.mcap")
    assert re.search(said, line), line
    assert len(read_lines(outcome.out)) == kept


def test_damage_anywhere_is_found_or_does_not_matter(tmp_path: Path) -> None:
    def read_all(file: Path) -> list[Any]:
        return [one.recorded for one in Recording.of(file, None, {})]

    whole, damaged_file = recorded(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    expected, found = read_all(whole), 0
    for place in np.linspace(0, 1, 60, endpoint=False):
        damaged_file.write_bytes(whole.read_bytes())
        damaged(damaged_file, place)
        try:
            assert read_all(damaged_file) == expected
        except DatasetError:
            found += 1
    assert found > 50


def test_a_bad_image_leaves_the_predictions_before_it(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap", late_info())
    outcome = phd_exp("predict", run, "folder=a.mcap", "out=b.mcap")
    assert "the camera changes" in outcome.error
    assert len(read_lines(outcome.out)) == len(written(tmp_path / "b.mcap")["/detections"]) == 5


def test_a_time_that_messages_cannot_hold_is_refused(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    late = 2**31 * SECOND - 1000  # the time of recording is later, as that of an image without one is
    shot = image(pictures(1)[0], "rgb8", late)
    shot = shot._replace(content=shot.content | {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}})
    write(tmp_path / "a.mcap", [CAMERA, shot])
    outcome = phd_exp("predict", run, "folder=a.mcap", "out=b.mcap")
    assert "time: got 2.14748e+09 s; messages have times from 0 to 2147483648 s" in outcome.error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("predict", "folder=a.mcap", "out=a.mcap"), "out=a.mcap: is one of the files that are read"),
        (("track", "folder=bag", "out=bag/bag_0.mcap"), "out=bag/bag_0.mcap: is one of the files that are read"),
        (("predict", "image=a.png", "f=90", "topic=/front"), "topic: selects images of a recording"),
        (("predict", "folder=a.mcap", "object=1"), "object: selects"),
        (("fuse", "folder=a.mcap"), "folder=a.mcap: a recording has no poses of cameras"),
    ],
)
def test_wrong_arguments_are_refused(
    phd_exp: Callable, run: str, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    as_sqlite(tmp_path, [info((WIDTH, HEIGHT), K, START), image(pictures(1)[0], "rgb8", START)])
    recorded(tmp_path / "a.mcap", n=1)
    outcome = phd_exp(words[0], run, *words[1:])
    assert outcome.status == 2
    assert said in outcome.error


def test_a_file_that_exists_is_replaced_and_nothing_else_stays(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap", n=1)
    recorded(tmp_path / "b.mcap", n=2)
    assert phd_exp("predict", run, "folder=a.mcap", "out=b.mcap").status == 0
    assert len(written(tmp_path / "b.mcap")["/detections"]) == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mcap", "b.mcap"]
