"""Recordings for the viewer Rerun: of predictions, of fused scenes, and of paths.

Their world is that of the poses, or the frame of the camera: x right, y down, z forward, metres, as Rerun's RDF. The
outline of a region is the projection of its surface through the lens, in pixels of the user's image. Rerun itself
projects through pinholes alone; therefore outlines belong to the image.
"""

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from jaxtyping import Float
from PIL import Image
from scipy.spatial.transform import Rotation

from phd_exp.distributions.surfaces import ellipsoid, gaussian_radius, level_surface, outline
from phd_exp.fusion import Pose
from phd_exp.inference.answers import PER_CENT, Sighting
from phd_exp.inference.following import HERE, Followed
from phd_exp.inference.path_video import COLOURS, TRAIL
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.errors import UserError, writing
from phd_exp.records.own_images import Observed, views_of

LEVELS = (0.5, 0.9)
REGION, GAUSSIAN, TRUTH = (255, 176, 0), (100, 143, 255), (255, 255, 255)
OPACITY = {0.5: 160, 0.9: 70}  # of 255
JPEG_QUALITY = 90
POINT = -4.0  # Rerun's radius of a point: 4 px
HALF_90 = 1.645  # standard deviations from the middle to an end of the central 90 % of a Gaussian
Place = list[Any]
"""The parts of the path of an entity."""
Vectors = Float[np.ndarray, "n 3"]
Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


class SceneFile:
    """A `.rrd` file, begun with the first camera; what is written can be opened after an interruption.

    Args:
        file: to be written.
        cameras: the places of all cameras.
        has_time: whether depth is recorded over time.

    Raises OSError if the file cannot be written.
    """

    def __init__(self, file: Path, cameras: Sequence[Place], has_time: bool = False) -> None:
        self._file, self._cameras, self._has_time = file, cameras, has_time

    @cached_property
    def _stream(self) -> rr.RecordingStream:
        stream = rr.RecordingStream("phd_exp")
        self._require_room()
        stream.save(self._file, default_blueprint=self._layout())
        return stream

    def _layout(self) -> rrb.Blueprint:
        """Space on the left; on the right the images, and the depth over time."""
        images = [
            rrb.Spatial2DView(origin=rr.new_entity_path([*place, "image"]), name="/".join(map(str, place)))
            for place in self._cameras
        ]
        right = [rrb.Tabs(*images) if self._has_time else rrb.Grid(*images)]
        right += [rrb.TimeSeriesView(origin="/", name="depth (m)")] if self._has_time else []
        space = rrb.Spatial3DView(origin="/", name="space")
        return rrb.Blueprint(rrb.Horizontal(space, rrb.Vertical(*right)), collapse_panels=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, place: TracebackType | None
    ) -> None:
        if "_stream" in vars(self):
            self._stream.flush()
            self._stream.disconnect()
            self._require_room()

    def _require_room(self) -> None:
        """Raise UserError if the disk is full, on which Rerun ends its file without an error."""
        with writing(self._file, "view=", UserError), open(self._file, "ab") as stream:
            end = stream.tell()
            os.posix_fallocate(stream.fileno(), end, 1)
            stream.truncate(end)

    def at(self, timeline: str, **value: float) -> None:
        """What follows belongs to this place of a timeline: `sequence`, a number, or `duration`, in seconds."""
        self._stream.set_time(timeline, **value)

    def log(self, place: Place, *what: Any) -> None:
        """Rerun's components at a place, from here on."""
        self._stream.log(place, *what)

    def clear(self, *places: Place) -> None:
        """Nothing is at these places from here on."""
        for place in places:
            self.log(place, rr.Clear(recursive=True))

    def camera(self, place: Place, image: Image.Image, K: Matrix, pose: Pose, position: Vector | None) -> None:
        """A camera as a pinhole without its lens, and the image as it is, in space half-way to a position.

        Without a pose, the world is the frame of the camera, where y is down.
        """
        if pose is HERE:
            self._stream.log("/", rr.ViewCoordinates.RDF, static=True)
        R, t = pose.R.numpy(), pose.t.numpy()
        self.log(place, rr.Transform3D(translation=-R.T @ t, mat3x3=R.T))
        distance = None if position is None else float(np.linalg.norm(position)) / 2
        pinhole = rr.Pinhole(
            image_from_camera=K,
            resolution=image.size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=distance,
        )
        self.log([*place, "image"], pinhole, rr.Image(np.asarray(image)).compress(JPEG_QUALITY))

    def sighting(self, place: Place, on_image: Place, sighting: Sighting, pose: Pose) -> None:
        """The regions of a prediction in space and on the image, the ellipsoid of its moments, mode and truth."""
        camera, density, numbers, R = sighting.view.camera, sighting.density, sighting.numbers, pose.R.numpy()
        assert density is not None  # of probabilistic runs
        for level in LEVELS:
            surface = level_surface(density, level)
            mesh = rr.Mesh3D(
                vertex_positions=_into_world(camera.to_real(surface.vertices), pose),
                triangle_indices=surface.triangles,
                vertex_normals=camera.to_real(surface.normals) @ R,
                albedo_factor=[*REGION, OPACITY[level]],
            )
            self.log([*place, _named(level)], mesh)
            self.outline([*on_image, _named(level)], surface.vertices, camera, REGION)
        mean, covariance = _into_world(numbers["mean"], pose), R.T @ numbers["covariance"] @ R
        self.ellipsoids([*place, "gaussian"], mean, covariance, LEVELS[-1:])
        low, high = numbers["depth_interval"][PER_CENT.index(90)]
        label = f"depth {low:.4g} to {high:.4g} m (90 %)"
        self.point([*place, "mode"], _into_world(numbers["mode"], pose), REGION, label)
        if sighting.truth is not None:
            self.point([*place, "truth"], _into_world(camera.to_real(sighting.truth), pose), TRUTH, "truth")
        self.box([*on_image, "box"], sighting.detection.line.box)

    def outline(self, place: Place, points: Vectors, camera: VirtualCamera, colour: Sequence[int]) -> None:
        """The outline on the real image of a convex body, given by points in the frame of a virtual camera."""
        curve = outline(points, camera)
        if len(curve):
            self.log(place, rr.LineStrips2D([curve], colors=[colour]))
        else:
            self.clear(place)

    def gaussian(self, place: Place, mean: Vector, covariance: Matrix, label: str) -> None:
        """The ellipsoids of 50 and 90 % of a Gaussian in the world, and its mean."""
        self.ellipsoids([*place, "gaussian"], mean, covariance, LEVELS)
        self.point([*place, "mean"], mean, GAUSSIAN, label)

    def ellipsoids(self, place: Place, mean: Vector, covariance: Matrix, levels: Sequence[float]) -> None:
        """Ellipsoids of a Gaussian in the world, as lines."""
        variances, axes = np.linalg.eigh(covariance)
        turn = Rotation.from_matrix(axes * np.sign(np.linalg.det(axes))).as_quat()  # x, y, z, w, as Rerun's
        sizes = [gaussian_radius(level) * np.sqrt(np.maximum(variances, 0)) for level in levels]
        n, lines = len(levels), rr.components.FillMode.MajorWireframe
        shapes = rr.Ellipsoids3D(
            half_sizes=sizes, centers=[mean] * n, quaternions=[turn] * n, colors=[GAUSSIAN] * n, fill_mode=lines
        )
        self.log(place, shapes)

    def point(self, place: Place, at: Vector, colour: Sequence[int], label: str) -> None:
        """A point in the world, with its name."""
        self.log(place, rr.Points3D([at], colors=[colour], labels=[label], radii=[POINT]))

    def box(self, place: Place, box: Sequence[float] | None) -> None:
        """A box on an image, px; None removes it."""
        if box is None:
            self.clear(place)
        else:
            self.log(place, rr.Boxes2D(array=[box], array_format=rr.Box2DFormat.XYXY, colors=[TRUTH]))


def viewed(file: Path, sightings: Iterable[Sighting]) -> Iterator[Sighting]:
    """The sightings; each is recorded before it is yielded. One image is one step of the timeline."""
    objects, on_image = ["objects"], ["camera", "image", "objects"]
    with SceneFile(file, [["camera"]]) as recording:
        for number, (_, same) in enumerate(groupby(sightings, lambda one: one.detection.file)):
            for k, sighting in enumerate(same):
                if k == 0:
                    recording.at("image", sequence=number)
                    recording.clear(objects, on_image)
                    recording.camera(["camera"], sighting.image, sighting.view.camera.K, HERE, sighting.mode)
                recording.sighting([*objects, k], [*on_image, k], sighting, HERE)
                yield sighting


def of_scenes(file: Path, scenes: Sequence[Observed]) -> SceneFile:
    """An empty recording with a place for each camera of the scene that has most."""
    return SceneFile(file, [["cameras", k] for k in range(max(len(scene.detections) for scene in scenes))])


def viewed_scenes(
    recording: SceneFile, scenes: Sequence[Observed], sightings: Iterable[Sighting]
) -> Iterator[Sighting]:
    """The sightings of all scenes, in their order; each is recorded before it is yielded."""
    most = max(len(scene.detections) for scene in scenes)
    for (number, k, scene), sighting in zip(views_of(scenes), sightings, strict=True):
        camera = ["cameras", k]
        if k == 0:
            recording.at("scene", sequence=number)
            recording.clear(["views"], ["fused"], *(["cameras", j] for j in range(len(scene.detections), most)))
        poses = Pose.from_scene([scene.poses[k]])
        pose = Pose(poses.R[0], poses.t[0])
        recording.camera(camera, sighting.image, sighting.view.camera.K, pose, sighting.mode)
        recording.sighting(["views", k], [*camera, "image", "object"], sighting, pose)
        yield sighting


def add_fused(recording: SceneFile, answers: Sequence[Mapping[str, Any]]) -> None:
    """Record the fused position of each scene that has one."""
    for number, answer in enumerate(answers):
        if answer["status"] == "fused":
            recording.at("scene", sequence=number)
            recording.gaussian(["fused"], answer["mean"], answer["covariance"], f"scene {answer['scene']}")


def of_paths(file: Path, names: Sequence[str]) -> SceneFile:
    """An empty recording with a camera for each path."""
    return SceneFile(file, [[name, "camera"] for name in names], has_time=True)


def viewed_path(recording: SceneFile, name: str, path: Iterable[Followed]) -> Iterator[Followed]:
    """The frames of a path; each is recorded before it is yielded, with the latest positions of its track."""
    for _, track in groupby(path, lambda one: one.track):
        trail: deque[Vector] = deque(maxlen=TRAIL)
        for one in track:
            if one.state is not None:
                trail.append(one.state.mean.numpy())
            _add_frame(recording, name, one, trail)
            yield one


def _add_frame(recording: SceneFile, name: str, one: Followed, trail: Iterable[Vector]) -> None:
    """The camera with the image, and what is in its frame: box, outlines, depth with its 90 % interval, and path."""
    frame, place, on_image = one.frame, [name, "camera"], [name, "camera", "image", "object"]
    recording.at("time", duration=frame.time)
    recording.camera(
        place, Image.fromarray(frame.image), frame.K, frame.pose, one.in_camera[0] if one.state else None
    )
    recording.box([*place, "image", "box"], one.box)
    if one.state is None:
        recording.clear([name, "object"], [name, "path"], [name, "depth"], on_image)
        return
    (mean, covariance), camera = one.in_camera, one.facing
    colour = tuple(bytes.fromhex(COLOURS[one.status][1:]))
    for level in LEVELS:
        points = camera.to_virtual(ellipsoid(mean, covariance, level).vertices)
        recording.outline([*on_image, _named(level)], points, camera, colour)
    ends = mean[2] + HALF_90 * np.sqrt(covariance[2, 2]) * np.array([-1, 0, 1])
    recording.log([name, "depth"], rr.Scalars(ends), rr.SeriesLines(names=["5 %", "mean", "95 %"]))
    recording.gaussian([name, "object"], one.state.mean.numpy(), one.state.covariance.numpy(), one.status)
    recording.log([name, "path"], rr.LineStrips3D([np.stack(list(trail))], colors=[GAUSSIAN]))


def _named(level: float) -> str:
    """The last part of the place of a region."""
    return f"region_{100 * level:g}"


def _into_world(points: Float[np.ndarray, "*n 3"], pose: Pose) -> Float[np.ndarray, "*n 3"]:
    return np.asarray(pose.into_world(torch.from_numpy(points)).numpy())
