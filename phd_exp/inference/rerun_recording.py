"""What a recording for the viewer Rerun has: cameras, images with outlines, and regions and points in space.

Its world is that of the poses, or the frame of the camera: x right, y down, z forward, metres, as Rerun's RDF. The
outline of a region is the projection of its surface through the lens, in pixels of the user's image. Rerun itself
projects through pinholes alone; therefore outlines belong to the image.
"""

import os
from collections.abc import Sequence
from functools import cached_property
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

from phd_exp.distributions.surfaces import gaussian_radius, level_surface, outline
from phd_exp.fusion import Pose
from phd_exp.inference.answers import PER_CENT, Sighting
from phd_exp.optics.virtual import VirtualCamera
from phd_exp.records.errors import UserError, writing

LEVELS = (0.5, 0.9)
REGION, GAUSSIAN, TRUTH = (255, 176, 0), (100, 143, 255), (255, 255, 255)
OPACITY = {0.5: 160, 0.9: 70}  # of 255
JPEG_QUALITY = 90
POINT = -4.0  # Rerun's radius of a point: 4 px
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
        has_time: whether `depth` is recorded over time.

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

    def at(self, timeline: str, number: int) -> None:
        """What follows belongs to this step of a timeline."""
        self._stream.set_time(timeline, sequence=number)

    def at_time(self, seconds: float) -> None:
        """What follows belongs to this time."""
        self._stream.set_time("time", duration=seconds)

    def in_camera(self) -> None:
        """The world is the frame of the camera, where y is down."""
        self._stream.log("/", rr.ViewCoordinates.RDF, static=True)

    def clear(self, *places: Place) -> None:
        """Nothing is at these places from here on."""
        for place in places:
            self._stream.log(place, rr.Clear(recursive=True))

    def camera(self, place: Place, image: Image.Image, K: Matrix, pose: Pose, position: Vector | None) -> None:
        """A camera as a pinhole without its lens, and the image as it is, in space half-way to a position."""
        R, t = pose.R.numpy(), pose.t.numpy()
        self._stream.log(place, rr.Transform3D(translation=-R.T @ t, mat3x3=R.T))
        distance = None if position is None else float(np.linalg.norm(position)) / 2
        pinhole = rr.Pinhole(
            image_from_camera=K,
            resolution=image.size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=distance,
        )
        self._stream.log([*place, "image"], pinhole, rr.Image(np.asarray(image)).compress(JPEG_QUALITY))

    def sighting(self, place: Place, on_image: Place, sighting: Sighting, pose: Pose) -> None:
        """The regions of a prediction in space and on the image, the ellipsoid of its moments, mode and truth."""
        camera, density, R = sighting.view.camera, sighting.density, pose.R.numpy()
        assert density is not None  # of probabilistic runs
        for level in LEVELS:
            surface = level_surface(density, level)
            vertices = camera.to_real(surface.vertices)
            mesh = rr.Mesh3D(
                vertex_positions=_into_world(vertices, pose),
                triangle_indices=surface.triangles,
                vertex_normals=camera.to_real(surface.normals) @ R,
                albedo_factor=[*REGION, OPACITY[level]],
            )
            self._stream.log([*place, named(level)], mesh)
            self.outline([*on_image, named(level)], surface.vertices, camera, REGION)
        mean, covariance, interval = (
            sighting.batch.numbers[name][sighting.row] for name in ("mean", "covariance", "depth_interval")
        )
        self.ellipsoids([*place, "gaussian"], _into_world(mean, pose), R.T @ covariance @ R, LEVELS[-1:])
        low, high = interval[PER_CENT.index(90)]
        label = f"depth {low:.4g} to {high:.4g} m (90 %)"
        self.point([*place, "mode"], _into_world(camera.to_real(sighting.mode), pose), REGION, label)
        if sighting.detection.line.z is not None:
            truth = np.array(sighting.detection.position)
            self.point([*place, "truth"], _into_world(truth, pose), TRUTH, "truth")
        self.box([*on_image, "box"], sighting.detection.line.box)

    def outline(self, place: Place, points: Vectors, camera: VirtualCamera, colour: Sequence[int]) -> None:
        """The outline on the real image of a convex body, given by points in the frame of a virtual camera."""
        curve = outline(points, camera)
        if len(curve):
            self._stream.log(place, rr.LineStrips2D([curve], colors=[colour]))
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
        self._stream.log(place, shapes)

    def point(self, place: Place, at: Vector, colour: Sequence[int], label: str) -> None:
        """A point in the world, with its name."""
        self._stream.log(place, rr.Points3D([at], colors=[colour], labels=[label], radii=[POINT]))

    def box(self, place: Place, box: Sequence[float] | None) -> None:
        """A box on an image, px; None removes it."""
        if box is None:
            self.clear(place)
        else:
            self._stream.log(place, rr.Boxes2D(array=[box], array_format=rr.Box2DFormat.XYXY, colors=[TRUTH]))

    def path(self, place: Place, positions: Vectors) -> None:
        """A line through positions in the world."""
        self._stream.log(place, rr.LineStrips3D([positions], colors=[GAUSSIAN]))

    def depth(self, place: Place, values: Vector) -> None:
        """The lower end of the 90 % interval, the mean, and the upper end, over time, metres."""
        self._stream.log(place, rr.Scalars(values), rr.SeriesLines(names=["5 %", "mean", "95 %"]))


def named(level: float) -> str:
    """The last part of the place of a region."""
    return f"region_{100 * level:g}"


def _into_world(points: Float[np.ndarray, "*n 3"], pose: Pose) -> Float[np.ndarray, "*n 3"]:
    return np.asarray(pose.into_world(torch.from_numpy(points)).numpy())
