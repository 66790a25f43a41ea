"""Reads the record of scenes with several cameras: predictions of every view, poses, and the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import COVARIANCE, PARAMETERS, from_columns, parameter_names
from phd_exp.evaluation.parquet import read_table, require_columns, stacked
from phd_exp.evaluation.predictions import XYZ
from phd_exp.fusion import Plane, Pose
from phd_exp.records import scenes
from phd_exp.records.errors import RunError, gist

ROTATION = ("pose_w", "pose_x", "pose_y", "pose_z")
TRANSLATION = ("pose_t_x", "pose_t_y", "pose_t_z")
"""Columns of a camera's pose: the unit quaternion of R, and t (m), of v_camera = R v_scene + t."""
NEEDED = ("scene", "view", "scale", *XYZ, *ROTATION, *TRANSLATION)
OF_FRAMES = ("track", "time", "visibility")
"""Further columns of a sequence."""
MOMENTS = ("mean_x", "mean_y", "mean_z", *COVARIANCE)
"""Further columns of a density that is no Projected Huber density, which has `parameter_names`."""
TILT = math.radians(30)  # angle by which the first camera looks down at the ground; see `SeveralViews.ground`
AGAIN = "delete it and repeat the command that made it"


@dataclass(frozen=True)
class SeveralViews:
    """Predictions of every view of every scene, and the truth.

    Args:
        columns: `NEEDED`, and `parameter_names` or `MOMENTS`; a row per scene and a column per view, float64.
        left_out: number of scenes that were removed because a value is not finite.
    """

    columns: Mapping[str, Float[Tensor, "scenes views"]]
    left_out: int = 0

    @property
    def n(self) -> int:
        """The number of scenes."""
        return self.columns["view"].shape[0]

    @property
    def views(self) -> int:
        """The number of cameras per scene."""
        return self.columns["view"].shape[1]

    @property
    def is_huber(self) -> bool:
        """Whether the predictions are Projected Huber densities."""
        return PARAMETERS[0] in self.columns

    @cached_property
    def predictions(self) -> ProjectedHuber:
        """The predictions, in the frame of each camera. Raises RunError if they are other densities."""
        require_columns(parameter_names(self.columns), self.columns, "several views")
        return from_columns(self.columns)

    @property
    def world_moments(self) -> tuple[Float[Tensor, "scenes views 3"], Float[Tensor, "scenes views 3 3"]]:
        """Mean (m) and covariance (m^2) of each view's density in the world: R^T (mean - t) and R^T C R."""
        if self.is_huber:
            mean, covariance = self.predictions.mean, self.predictions.covariance_matrix
        else:
            mean = stacked(self.columns, MOMENTS[:3])
            covariance = stacked(self.columns, [f"C_{''.join(sorted(i + j))}" for i in "xyz" for j in "xyz"])
            covariance = covariance.unflatten(-1, (3, 3))
        return self.pose.into_world(mean), self.pose.R.mT @ covariance @ self.pose.R

    @cached_property
    def pose(self) -> Pose:
        """The pose of each camera in the scene's world."""
        rows = stacked(self.columns, (*ROTATION, *TRANSLATION)).flatten(0, 1).tolist()
        flat = Pose.from_scene([scenes.Pose(rotation=row[:4], translation=row[4:]) for row in rows])
        shape = (self.n, self.views)
        return Pose(flat.R.unflatten(0, shape), flat.t.unflatten(0, shape))

    @property
    def first(self) -> Pose:
        """The pose of the first camera of each scene."""
        return Pose(self.pose.R[:, 0], self.pose.t[:, 0])

    @property
    def xyz(self) -> Float[Tensor, "scenes views 3"]:
        """True position in the frame of each camera, metres."""
        return stacked(self.columns, XYZ)

    @property
    def truth(self) -> Float[Tensor, "scenes 3"]:
        """True position in the world, metres."""
        return self.first.into_world(self.xyz[:, 0])

    @property
    def ground(self) -> Plane:
        """A plane through the true position: the ground in front of a first camera that looks down by `TILT`.

        Its normal, gravity in that camera's frame, is (0, cos TILT, sin TILT). A level camera sees its ground almost
        edge-on, so that the place in the image hardly determines the distance.
        """
        gravity = torch.tensor([0.0, math.cos(TILT), math.sin(TILT)], dtype=torch.float64)
        normal = self.first.R.mT @ gravity
        return Plane(normal, (normal * self.truth).sum(-1))

    def cameras(self, k: int) -> "SeveralViews":
        """The first k cameras of every scene."""
        return SeveralViews({name: column[:, :k] for name, column in self.columns.items()}, self.left_out)

    def subset(self, chosen: Bool[Tensor, " scenes"]) -> "SeveralViews":
        """The chosen scenes; the others count as left out."""
        columns = {name: column[chosen] for name, column in self.columns.items()}
        return SeveralViews(columns, self.left_out + int((~chosen).sum()))


def read_views(file: Path) -> SeveralViews:
    """The recorded views of a run. Raises RunError if they cannot be read, or are not views of several cameras."""
    table = read_table(file)
    needed = (*NEEDED, *(MOMENTS if COVARIANCE[0] in table else parameter_names(table)))
    require_columns(needed, table, str(file))
    flat = {name: torch.from_numpy(table[name]) for name in needed}
    rows = torch.arange(len(flat["view"]), dtype=torch.float64)
    views = int(flat["view"].max()) + 1
    if views < 2 or len(rows) % views or not bool((flat["scene"] * views + flat["view"] == rows).all()):
        raise RunError(f"{file}: not every view of every scene, two or more, in order; {AGAIN}")
    return _finite(flat, views, file)


def read_sequences(file: Path) -> list[SeveralViews]:
    """The recorded sequences of a run, one item per camera: views are frames, with `time` (s) and `visibility`.

    Raises RunError if they cannot be read, or are not sequences of equal length.
    """
    table = read_table(file)
    needed = (*NEEDED, *OF_FRAMES, *parameter_names(table))
    require_columns(needed, table, str(file))
    flat = {name: torch.from_numpy(table[name]) for name in needed}
    images, cameras = int((flat["track"] == 0).sum()), int(flat["view"].max()) + 1
    n, rest = divmod(len(flat["track"]), max(images, 1))
    tracks, views = torch.arange(n).repeat_interleave(images), torch.arange(images).repeat(n) % cameras
    in_order = not rest and torch.equal(flat["track"], tracks.double()) and torch.equal(flat["view"], views.double())
    if images < 2 * cameras or images % cameras or not in_order:
        raise RunError(f"{file}: not sequences of equal length, two frames or more, in order; {AGAIN}")
    found = _finite(flat, images, file)
    each = [{name: values[:, camera::cameras] for name, values in found.columns.items()} for camera in range(cameras)]
    time = each[0]["time"]
    if not bool((time.diff() > 0).all()) or any(not torch.equal(one["time"], time) for one in each):
        raise RunError(f"{file}: the times of a sequence do not increase; {AGAIN}")
    return [SeveralViews(columns, found.left_out) for columns in each]


def _finite(flat: Mapping[str, Tensor], views: int, file: Path) -> SeveralViews:
    """The scenes, of so many rows each, whose values are finite and whose predictions are densities."""
    columns = {name: column.reshape(-1, views) for name, column in flat.items()}
    finite = torch.stack(list(columns.values())).isfinite().all(0).all(-1)
    if not bool(finite.any()):
        raise RunError(f"{file}: of no scene all predictions are finite; train longer")
    found = SeveralViews(columns).subset(finite)
    try:
        _ = found.world_moments
    except ValueError as error:
        raise RunError(f"{file}: no predictions with poses ({gist(error)}); {AGAIN}") from None
    return found
