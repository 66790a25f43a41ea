"""Recordings for the viewer Rerun: of predictions, of fused scenes, and of paths."""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phd_exp.distributions.surfaces import ellipsoid
from phd_exp.fusion import Pose
from phd_exp.inference.answers import Sighting
from phd_exp.inference.following import HERE, Followed
from phd_exp.inference.path_video import COLOURS, TRAIL
from phd_exp.inference.rerun_recording import LEVELS, Place, SceneFile, Vector, named
from phd_exp.optics.virtual import VirtualCamera, towards
from phd_exp.records.own_images import Observed, views_of

HALF_90 = 1.645  # standard deviations from the middle to an end of the central 90 % of a Gaussian


def viewed(file: Path, sightings: Iterable[Sighting]) -> Iterator[Sighting]:
    """The sightings; each is recorded before it is yielded. One image is one step of the timeline."""
    objects, on_image = ["objects"], ["camera", "image", "objects"]
    with SceneFile(file, [["camera"]]) as recording:
        for number, (_, same) in enumerate(groupby(sightings, lambda one: one.detection.file)):
            for k, sighting in enumerate(same):
                if k == 0:
                    recording.at("image", number)
                    recording.in_camera()
                    recording.clear(objects, on_image)
                    recording.camera(["camera"], sighting.image, sighting.view.camera.K, HERE, sighting.mode)
                recording.sighting([*objects, k], [*on_image, k], sighting, HERE)
                yield sighting


def of_scenes(file: Path, scenes: Sequence[Observed]) -> SceneFile:
    """An empty recording with a place for each camera of the scene that has most."""
    return SceneFile(file, [_camera(k) for k in range(max(len(scene.detections) for scene in scenes))])


def viewed_scenes(
    recording: SceneFile, scenes: Sequence[Observed], sightings: Iterable[Sighting]
) -> Iterator[Sighting]:
    """The sightings of all scenes, in their order; each is recorded before it is yielded."""
    most = max(len(scene.detections) for scene in scenes)
    for (number, k, scene), sighting in zip(views_of(scenes), sightings, strict=True):
        if k == 0:
            recording.at("scene", number)
            recording.clear(["views"], ["fused"], *map(_camera, range(len(scene.detections), most)))
        poses = Pose.from_scene([scene.poses[k]])
        pose = Pose(poses.R[0], poses.t[0])
        recording.camera(_camera(k), sighting.image, sighting.view.camera.K, pose, sighting.mode)
        recording.sighting(["views", k], [*_camera(k), "image", "object"], sighting, pose)
        yield sighting


def add_fused(recording: SceneFile, answers: Sequence[Mapping[str, Any]]) -> None:
    """Record the fused position of each scene that has one."""
    for number, answer in enumerate(answers):
        if answer["status"] == "fused":
            recording.at("scene", number)
            mean, covariance = np.array(answer["mean"]), np.array(answer["covariance"])
            recording.gaussian(["fused"], mean, covariance, f"scene {answer['scene']}")


def of_paths(file: Path, names: Sequence[str]) -> SceneFile:
    """An empty recording with a camera for each path."""
    return SceneFile(file, [[name, "camera"] for name in names], has_time=True)


def viewed_path(recording: SceneFile, name: str, path: Iterable[Followed]) -> Iterator[Followed]:
    """The frames of a path; each is recorded before it is yielded, with the latest positions of its track."""
    for _, track in groupby(path, lambda one: one.track):
        trail: deque[Vector] = deque(maxlen=TRAIL)
        for one in track:
            _add_frame(recording, name, one)
            if one.state is None:
                image = [name, "camera", "image"]
                recording.clear([name, "object"], [name, "path"], [name, "depth"], [*image, "object"])
            else:
                trail.append(one.state.mean.numpy())
                recording.gaussian([name, "object"], trail[-1], one.state.covariance.numpy(), one.status)
                recording.path([name, "path"], np.stack(list(trail)))
            yield one


def _add_frame(recording: SceneFile, name: str, one: Followed) -> None:
    """The camera with the image, and what is in its frame: box, outlines, depth with its 90 % interval."""
    frame, place = one.frame, [name, "camera"]
    recording.at_time(frame.time)
    if frame.pose is HERE:
        recording.in_camera()
    mean, covariance = (None, None) if one.state is None else one.in_camera
    recording.camera(place, Image.fromarray(frame.image), frame.K, frame.pose, mean)
    recording.box([*place, "image", "box"], one.box)
    if mean is None or covariance is None:
        return
    camera = VirtualCamera(frame.K, towards(mean), 1.0, 1.0, frame.lens)
    colour = tuple(bytes.fromhex(COLOURS[one.status][1:]))
    for level in LEVELS:
        points = camera.to_virtual(ellipsoid(mean, covariance, level).vertices)
        recording.outline([*place, "image", "object", named(level)], points, camera, colour)
    recording.depth([name, "depth"], mean[2] + HALF_90 * np.sqrt(covariance[2, 2]) * np.array([-1, 0, 1]))


def _camera(k: int) -> Place:
    return ["cameras", k]
