"""`track` with a network of random weights: what it reads and writes, the boxes that follow a path, and mistakes."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.geometry import Lens, intrinsics
from phd_exp.inference.following import Frame, _Outline
from phd_exp.records.errors import DatasetError
from phd_exp.records.runs import RunFolder
from phd_exp.records.videos import VideoWriter, shots_in
from tests.support.untrained import NOWHERE, read_lines

N, WIDTH, HEIGHT = 14, 64, 48
K = intrinsics(90.0, 90.0, WIDTH / 2, HEIGHT / 2)


@pytest.fixture(scope="module")
def run(make: Callable[..., RunFolder]) -> str:
    return f"run={make(*NOWHERE).path}"


def images(n: int = N) -> list[np.ndarray]:
    """A bright square that moves over a grey ground."""
    found = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8) for _ in range(n)]
    for k, image in enumerate(found):
        image[15:35, 10 + k : 30 + k] = 200, 120, 40
    return found


def frames(folder: Path, **changes: dict[int, Any]) -> str:
    """The word of a folder of frames with times; `changes` are values of a key by frame."""
    lines = []
    for k, image in enumerate(images()):
        Image.fromarray(image).save(folder / f"{k}.png")
        line = {"file_name": f"{k}.png", "f": 90.0, "time": k / 20, "track": "ball"}
        line |= {key: values[k] for key, values in changes.items() if k in values}
        lines.append(json.dumps(line))
    (folder / "metadata.jsonl").write_text("\n".join(lines))
    return f"folder={folder}"


def test_each_frame_of_a_folder_has_a_line(phd_exp: Callable, run: str, tmp_path: Path) -> None:
    outcome = phd_exp("track", run, frames(tmp_path), "least_familiar=0.01", "depth_time=2", "speed=0.5")
    assert (outcome.status, outcome.err) == (0, "")
    lines = read_lines(outcome.out)
    assert [line["frame"] for line in lines] == list(range(N))
    assert [line["time"] for line in lines] == [k / 20 for k in range(N)]
    for line in lines:
        assert (line["name"], line["track"]) == ("ball", 0)
        assert line["state"] in ("tracked", "bridged")
        low, high = line["depth_interval"]["90"]
        assert low < line["mean"][2] < high
        assert np.linalg.eigvalsh(line["covariance"]).min() > 0


@pytest.mark.parametrize(
    ("changes", "said", "kept"),
    [
        ({"time": {6: 0.25}}, "line 7: time: got 0.25 after 0.25; expected increasing times", 6),
        ({"time": {6: None}}, "line 7: time is missing; expected the time of the image, seconds", 6),
        ({"pose": {2: {"rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}}}, "line 1: pose is missing; expected", 0),
        ({"file_name": {6: "other.png"}}, "line 7: got 30 x 20 pixels; expected 64 x 48 as in the first frame", 6),
        ({"box": {0: [8, 12, 32, 38], 6: [70, 0, 90, 9]}}, "line 7: box=[70.0, 0.0, 90.0, 9.0] lies outside", 6),
    ],
)
def test_a_bad_frame_is_refused_on_one_line_and_those_before_are_kept(
    phd_exp: Callable, run: str, tmp_path: Path, changes: dict[str, Any], said: str, kept: int
) -> None:
    Image.new("RGB", (30, 20)).save(tmp_path / "other.png")
    outcome = phd_exp("track", run, frames(tmp_path, **changes))
    assert outcome.status == 1
    (line,) = outcome.err.splitlines()
    assert said in line
    assert len(read_lines(outcome.out)) == kept


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "track: expected either video=FILE with f=PIXELS or camera=FILE, or folder=DIR"),
        (("video=a.mp4",), "video: has no camera"),
        (("folder=.", "f=3"), "folder: its metadata.jsonl has cameras"),
        (("video=a.mp4", "f=90", "object=1"), "object: selects detections of boxes=FILE"),
        (("folder=.", "noise=0"), "noise: got '0'; expected to be greater than or equal to 0.001"),
    ],
)
def test_wrong_arguments_are_refused(phd_exp: Callable, words: tuple[str, ...], said: str) -> None:
    outcome = phd_exp("track", "run=nowhere", *words)
    assert outcome.status == 2
    assert said in outcome.err


@pytest.mark.parametrize("lens", [Lens(), Lens((-0.2, 0.05)), Lens((0.01,), is_fisheye=True)])
def test_the_box_of_an_outline_moves_and_grows_with_the_object(lens: Lens) -> None:
    frame = Frame(0.0, images(1)[0], K, (), lens=lens)
    box = (30.0, 20.0, 38.0, 28.0)
    outline, here, none = _Outline.of(box, frame), np.array([0.1, 0.0, 4.0]), np.zeros((3, 3))
    assert outline is not None
    outline.place(here)
    assert outline.box(frame, here, none) == pytest.approx(box, abs=0.05)
    farther = outline.box(frame, 2 * here, none)
    assert farther is not None
    assert farther[2] - farther[0] == pytest.approx(4, rel=0.02)
    wider = outline.box(frame, here, 1e-4 * np.eye(3))
    assert wider is not None
    assert wider[0] == pytest.approx(30 - 2 * 0.01 / 4 * 90, abs=0.1)  # two standard deviations
    widest = outline.box(frame, here, np.eye(3))
    assert widest == pytest.approx((28, 18, 40, 30), abs=0.3)
    assert outline.box(frame, np.array([4.0, 0.0, 4.0]), none) is None  # outside the image
    assert outline.box(frame, np.array([0.0, 0.0, -4.0]), none) is None


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A video whose frames have unequal distances."""
    pytest.importorskip("av")
    file = tmp_path / "clip.mp4"
    with VideoWriter(file, (WIDTH, HEIGHT)) as writer:
        for k, image in enumerate(images()):
            writer.add(k**1.5 / 20, image)
    return file


def test_a_video_has_its_times_and_pixels(video: Path) -> None:
    shots = list(shots_in(video, 2))
    assert [shot.number for shot in shots] == list(range(0, N, 2))
    assert [shot.time for shot in shots] == pytest.approx([k**1.5 / 20 for k in range(0, N, 2)], abs=1e-4)
    error = np.abs(shots[3].image.astype(int) - images()[6])
    assert error.mean() < 5


def test_a_video_is_followed_from_one_box(phd_exp: Callable, run: str, video: Path, tmp_path: Path) -> None:
    words = ("track", run, f"video={video}", "f=90", "stride=2")
    outcome = phd_exp(*words, "box=8,12,32,38", f"out={tmp_path / 'out'}")
    assert outcome.status == 0, outcome.err
    lines = read_lines((tmp_path / "out/track.jsonl").read_text())
    assert [line["frame"] for line in lines] == list(range(0, N, 2))
    assert lines[0]["box"] == [8, 12, 32, 38]
    assert len(list(shots_in(tmp_path / "out/track.mp4"))) == len(lines)
    boxes = [{"image_id": k, "category_id": 3, "bbox": [8 + k, 12, 24, 26], "score": 0.5} for k in range(0, N, 4)]
    (tmp_path / "boxes.json").write_text(json.dumps(boxes))
    outcome = phd_exp(*words, f"boxes={tmp_path / 'boxes.json'}", "object=3")
    assert outcome.status == 0, outcome.err
    assert len(read_lines(outcome.out)) == len(lines)


@pytest.mark.parametrize(
    ("frames", "score", "said"),
    [
        ([1], 0.5, "none of a frame"),
        ([99], 0.5, "none of a frame"),
        ([0], None, "score None"),
        (range(1, N + 1), 0.5, f"got image_id 1 to {N}; expected numbers of frames from 0"),
    ],
)
def test_boxes_of_other_frames_are_explained(
    phd_exp: Callable, video: Path, tmp_path: Path, frames: Sequence[int], score: float | None, said: str
) -> None:
    boxes = tmp_path / "boxes.json"
    given = [{"image_id": frame, "category_id": 1, "bbox": [9, 9, 9, 9], "score": score} for frame in frames]
    boxes.write_text(json.dumps(given))
    outcome = phd_exp("track", "run=nowhere", f"video={video}", "f=900", f"boxes={boxes}", "stride=2")
    assert outcome.status  # a note, if the frames may count from 1; then there is no run
    assert said in outcome.err.splitlines()[0]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda content: content[: len(content) * 3 // 4], "ends in the middle of a frame|cannot be read as a video"),
        (lambda content: b"", "cannot be read as a video"),
        (lambda content: content[:600], "no frame can be decoded|cannot be read as a video"),
        (lambda content: b"text" * 99, "cannot be read as a video"),
    ],
)
def test_a_broken_video_is_refused(video: Path, spoil: Callable[[bytes], bytes], said: str) -> None:
    video.write_bytes(spoil(video.read_bytes()))
    with pytest.raises(DatasetError, match=said):
        list(shots_in(video))


@pytest.mark.parametrize(
    "playlist",
    [
        "ffconcat version 1.0\nfile other.mp4\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nother.mp4\n#EXT-X-ENDLIST\n",
    ],
)
def test_a_playlist_reads_no_other_file(video: Path, playlist: str) -> None:
    video.rename(video.with_name("other.mp4"))
    for name in ("clip.mp4", "clip.m3u8", "clip.ffconcat"):
        video.with_name(name).write_text(playlist)
        with pytest.raises(DatasetError, match="cannot be read as a video"):
            list(shots_in(video.with_name(name)))


def test_a_video_that_ends_early_is_refused_after_its_frames(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    file = tmp_path / "clip.mkv"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"tune": "zerolatency"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for image in images():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    assert len(list(shots_in(file))) == N
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 3 // 4])
    shots = shots_in(file)
    next(shots)
    with pytest.raises(DatasetError, match=r"clip\.mkv: .*ends at .* s of .* s, after \d+ frames"):
        list(shots)
