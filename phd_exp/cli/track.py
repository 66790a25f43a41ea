"""`python -m phd_exp track`: the path of an object through a video or a folder of images, as JSON lines."""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from pydantic import Field, model_validator

from phd_exp.cli.arguments import loaded, noting, with_bar
from phd_exp.cli.detecting import DetectingArguments
from phd_exp.cli.outputs import message_file, places
from phd_exp.records.detections import detections_of
from phd_exp.records.errors import ConfigError, UserError, writing
from phd_exp.records.foreign import boxes_of_images
from phd_exp.records.messages import optical_frame
from phd_exp.records.own_images import detections_in, tracks_of
from phd_exp.records.processes import announce
from phd_exp.records.recordings import MCAP, is_recording
from phd_exp.records.videos import length_of, require_av
from phd_exp.records.written import Written

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.inference.detectors import Detector
    from phd_exp.inference.following import Followed, Frame
    from phd_exp.inference.predictor import Predictor
    from phd_exp.inference.rerun_view import SceneFile

Box = tuple[float, float, float, float]
AFTER_LOSS = "boxes= begins another track; a larger noise= follows faster motion, least_familiar=0.01 a hidden object"
LEAST_LAG = 4  # five frames in a row that contradict a path end it


class TrackArguments(DetectingArguments):
    """The run, the video with its camera and box, or the folder; lengths in pixels of the images."""

    video: Path | None = None
    """a video file, with its camera as f=, fx= and fy=, or camera="""
    folder: Path | None = None
    """instead of video=: images with metadata.jsonl that has time (s), and track for several; or a ROS 2 recording"""
    stride: Annotated[int, Field(ge=1)] = 1
    """use every stride-th frame of the video or recording"""
    noise: Annotated[float, Field(ge=1e-3, le=1e3)] = 1.0
    """how fast the velocity changes: by noise m/s in a second, growing with the root of time"""
    speed: Annotated[float, Field(ge=1e-3, le=1e3)] = 10.0
    """how fast the object may move in the first frame, m/s (standard deviation along each axis)"""
    lag: Annotated[int, Field(ge=LEAST_LAG, le=1000)] = 10
    """how many later frames the state of a frame takes into account; as many images are in memory"""
    depth_time: Annotated[float, Field(ge=0, le=1e6)] = 1.0
    """correlation time of the errors of depth, s; 0 for independent frames"""
    projection_time: Annotated[float, Field(ge=0, le=1e6)] = 0.1
    """correlation time of the errors of direction, s"""
    least_familiar: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """leave out predictions that are more unusual than this, see familiar in the lines: the object may be hidden"""
    out: Path | None = None
    """a folder for track.jsonl and videos; or FILE.mcap for ROS 2 messages, in addition to printed lines"""
    view: Path | None = None
    """a new file *.rrd for the viewer Rerun: images with outlines, ellipsoids and the path in space, over time"""

    @model_validator(mode="after")
    def one_source(self) -> "TrackArguments":
        """Require a video with its camera, or a folder with both."""
        if (self.video is None) == (self.folder is None):
            raise ValueError("track: expected either video=FILE with f=PIXELS or camera=FILE, or folder=DIR")
        described = self.folder and not is_recording(self.folder)
        if described and (self.of_camera or (self.boxes and not self.function) or self.stride > 1):
            raise ValueError(
                "folder: its metadata.jsonl has cameras and boxes; expected no f=, camera=, box=, stride="
            )
        if self.video and not self.of_camera.keys() - {"box"}:
            raise ValueError("video: has no camera; expected f=PIXELS, fx= and fy=, or camera=FILE too")
        if self.object is not None and not self.boxes:
            raise ValueError("object: selects detections of boxes=FILE; leave it out for one box")
        return self


class _Sequence(NamedTuple):
    """The frames of one path, their number if it is known, and a name that files may have.

    For messages of ROS 2, the time 0 of the frames in ns, and the name of the camera's frame.
    """

    frames: Iterable["Frame"]
    length: int | None
    name: str
    origin: int = 0
    camera: str = optical_frame("camera")


def main(words: list[str]) -> int:
    """Follow each object; returns the exit status."""
    arguments = TrackArguments.parsed("track", words)
    out = arguments.out
    if arguments.video or (out and out.suffix != MCAP):
        require_av("video" if arguments.video else "out")
    detector = arguments.detector()  # whose mistakes need no network
    sequences = list(_sequences(arguments))
    if out is not None and out.suffix == MCAP and len(sequences) > 1:
        raise ConfigError(f"out: got {len(sequences)} tracks; expected one track for {out}, or out=DIR")
    names = [_video(number, len(sequences)) for number in range(len(sequences))]
    places(arguments, [arguments.folder or Path(str(arguments.video))], "track", ["track.jsonl", *names])
    predictor = loaded(arguments)
    predictor.require_densities("a path needs")
    with _recording(arguments, sequences) as view:
        paths = [(sequence, _followed(arguments, predictor, detector, sequence, view)) for sequence in sequences]
        if out is not None and out.suffix != MCAP:
            _write(arguments, predictor, paths, out)
        else:
            _print(arguments, predictor, paths)
    return 0


def _recording(
    arguments: TrackArguments, sequences: Sequence[_Sequence]
) -> AbstractContextManager["SceneFile | None"]:
    """The recording for view=, if it is given."""
    if arguments.view is None:
        return nullcontext()
    from phd_exp.inference.rerun_view import of_paths

    return of_paths(arguments.view, [sequence.name for sequence in sequences])


def _sequences(arguments: TrackArguments) -> Iterator[_Sequence]:
    recording, folder, stride = arguments.recording(arguments.folder), arguments.folder, arguments.stride
    if folder and not recording:
        tracks = tracks_of(detections_in(folder))
        from phd_exp.inference.frames import of_folder

        for name, detections in tracks.items():
            frames = of_folder(detections, has_boxes=bool(arguments.function))
            yield _Sequence(frames, len(detections), str(folder.name if name is None else name))
        return
    boxes: dict[int, list[Box]] | None = {} if arguments.function else None
    if arguments.boxes and not arguments.function:
        boxes = _boxes_of_frames(arguments.boxes, arguments.object)
    elif arguments.box:
        boxes = {0: [arguments.box]}
    video = Path(str(arguments.video))
    length = len(recording) if recording else length_of(video)
    if boxes:
        _require_frames(boxes, length, stride)
    from phd_exp.inference.frames import of_recording, of_video

    n = length and -(-length // stride)
    if recording:
        frames = of_recording(recording, boxes, stride)
        yield _Sequence(frames, n, recording.path.stem, recording.start, recording.frame)
    else:
        (camera,) = detections_of([video], arguments.of_camera)
        yield _Sequence(of_video(video, camera, boxes, stride), n, video.stem)


def _require_frames(boxes: dict[int, list[Box]], length: int | None, stride: int) -> None:
    """Raise ConfigError if no box is in a frame that is used; a length may be unknown, or an estimate."""
    first, last = min(boxes), max(boxes)
    if first == 1 and last >= (length or 0):
        announce(f"note: boxes: got image_id 1 to {last}; expected numbers of frames from 0")
    if not any(n % stride == 0 and n < (length or math.inf) for n in boxes):
        used = "every frame" if stride == 1 else f"frames 0, {stride}, ..."
        raise ConfigError(
            f"boxes: got image_id {first} to {last}, none of a frame; expected numbers from 0, of {used}"
        )


def _boxes_of_frames(file: Path, category: int | str | None) -> dict[int, list[Box]]:
    """The boxes of each frame, the most certain first. Raises ConfigError for other names of frames, or scores."""
    found: dict[int, list[Box]] = {}
    for name, given in boxes_of_images(file, category).items():
        if not name.isdecimal():
            raise ConfigError(f"boxes: got image_id {name}; expected the number of a frame, from 0")
        scores = [one.get("score", 0.0) for one in given]
        if wrong := [score for score in scores if not isinstance(score, int | float)]:
            raise ConfigError(f"boxes: got the score {wrong[0]} in frame {name}; expected a number, or no score")
        order = sorted(range(len(given)), key=lambda k: -scores[k])
        found[int(name)] = [tuple(given[k]["box"]) for k in order]
    return found


def _followed(
    arguments: TrackArguments,
    predictor: "Predictor",
    detector: "Detector | None",
    sequence: _Sequence,
    view: "SceneFile | None",
) -> Iterator["Followed"]:
    """The frames with their states, in the recording for view= first, with a progress bar on a terminal."""
    from phd_exp.fusion.tracks import ConstantVelocity, Slow
    from phd_exp.inference.following import follow

    followed = follow(
        predictor,
        sequence.frames,
        ConstantVelocity(arguments.noise, arguments.speed),
        arguments.lag,
        Slow(arguments.depth_time, arguments.projection_time),
        least_familiar=arguments.least_familiar,
        detector=detector,
        beyond=arguments.beyond,
    )
    if view is not None:
        from phd_exp.inference.rerun_view import viewed_path

        followed = viewed_path(view, sequence.name, followed)
    followed = noting(followed, lambda one: (one.frame.where, one.warnings), "frames")
    for one in with_bar(followed, f"tracking {sequence.name}", sequence.length):
        if one.reason:
            announce(f"note: {one.frame.where}: {one.reason}; {AFTER_LOSS}")
        yield one


def _line(arguments: TrackArguments, predictor: "Predictor", sequence: _Sequence, followed: "Followed") -> str:
    numbers = followed.answer(predictor) | {"frame": arguments.stride * followed.number}
    return json.dumps({"name": sequence.name} | numbers, allow_nan=False)


def _print(
    arguments: TrackArguments, predictor: "Predictor", paths: list[tuple[_Sequence, Iterator["Followed"]]]
) -> None:
    with message_file(arguments.out) as messages:
        for sequence, path in paths:
            if messages is not None:
                from phd_exp.inference.ros import write_path

                path = write_path(messages, sequence.name, sequence.origin, sequence.camera, path)
            for followed in path:
                print(_line(arguments, predictor, sequence, followed), flush=True)


def _video(number: int, n: int) -> str:
    """The name of the video of a path, which has a number if there are several."""
    return f"{number + 1:0{len(str(n))}}.mp4" if n > 1 else "track.mp4"


def _write(
    arguments: TrackArguments,
    predictor: "Predictor",
    paths: Sequence[tuple[_Sequence, Iterator["Followed"]]],
    out: Path,
) -> None:
    """Write each line before its frame of the video, whose name begins with the number of its sequence."""
    from phd_exp.inference.path_video import PathVideo

    with (
        writing(out, "out=DIR", UserError),
        Written(out, "track") as written,
        open(file := written.place("track.jsonl"), "w", buffering=1) as lines,
    ):
        for number, (sequence, path) in enumerate(paths):
            with PathVideo(written.place(_video(number, len(paths)))) as video:
                for followed in path:
                    lines.write(_line(arguments, predictor, sequence, followed) + "\n")
                    video.add(followed)
    announce(f"{file}, and a video for each path")
