"""The record of scenes that several cameras see: predictions of every view, poses, and the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import PARAMETERS, from_columns
from phd_exp.evaluation.parquet import read_table
from phd_exp.fusion import Plane, Pose
from phd_exp.records import scenes
from phd_exp.records.errors import RunError

XYZ = ("x", "y", "z")
ROTATION = ("pose_w", "pose_x", "pose_y", "pose_z")
TRANSLATION = ("pose_t_x", "pose_t_y", "pose_t_z")
"""Columns of a camera's pose: the unit quaternion of R and the translation (m) of v_camera = R v_scene + t."""
NEEDED = ("scene", "view", "scale", *XYZ, *ROTATION, *TRANSLATION, *PARAMETERS)
TILT = math.radians(30)
"""How far the first camera looks down at the ground, on which planes are tried; see `ground`."""
AGAIN = "delete it and say the command again that made it"


@dataclass(frozen=True)
class SeveralViews:
    """Predictions of every view of every scene, and the truth.

    Args:
        columns: those `NEEDED`, a row a scene and a column a view, float64.
        left_out: scenes that are not among them, because something of them was not finite.
    """

    columns: Mapping[str, Float[Tensor, "scenes views"]]
    left_out: int = 0

    @property
    def n(self) -> int:
        """How many scenes there are."""
        return self.columns["view"].shape[0]

    @property
    def views(self) -> int:
        """How many cameras look at each."""
        return self.columns["view"].shape[1]

    @cached_property
    def predictions(self) -> ProjectedHuber:
        """In the frame of each camera."""
        return from_columns(self.columns)

    @cached_property
    def pose(self) -> Pose:
        """Of each camera in the scene's world."""
        rotation, translation = (
            self._stacked(names).reshape(-1, len(names)).tolist() for names in (ROTATION, TRANSLATION)
        )
        flat = Pose.from_scene(
            [scenes.Pose(rotation=q, translation=t) for q, t in zip(rotation, translation, strict=True)]
        )
        shape = (self.n, self.views)
        return Pose(flat.R.unflatten(0, shape), flat.t.unflatten(0, shape))

    @property
    def first(self) -> Pose:
        """The pose of the first camera of each scene."""
        return Pose(self.pose.R[:, 0], self.pose.t[:, 0])

    @property
    def xyz(self) -> Float[Tensor, "scenes views 3"]:
        """True position in the frame of each camera, metres."""
        return self._stacked(XYZ)

    @property
    def truth(self) -> Float[Tensor, "scenes 3"]:
        """True position in the world, metres."""
        return self.first.into_world(self.xyz[:, 0])

    @property
    def ground(self) -> Plane:
        """A plane through the true position: the ground before a first camera that looks down at it by `TILT`.

        Its normal, gravity in that camera's frame, is (0, cos TILT, sin TILT). A level camera would see its ground
        edge-on, and the place in the image would hardly tell how far away on it an object is.
        """
        gravity = torch.tensor([0.0, math.cos(TILT), math.sin(TILT)], dtype=torch.float64)
        normal = self.first.R.mT @ gravity
        return Plane(normal, (normal * self.truth).sum(-1))

    def cameras(self, k: int) -> "SeveralViews":
        """The first k cameras of every scene."""
        return SeveralViews({name: column[:, :k] for name, column in self.columns.items()}, self.left_out)

    def subset(self, chosen: Bool[Tensor, " scenes"]) -> "SeveralViews":
        """Some of the scenes; the others count as left out."""
        columns = {name: column[chosen] for name, column in self.columns.items()}
        return SeveralViews(columns, self.left_out + int((~chosen).sum()))

    def _stacked(self, names: tuple[str, ...]) -> Float[Tensor, "scenes views n"]:
        return torch.stack([self.columns[name] for name in names], -1)


def read_views(file: Path) -> SeveralViews:
    """The record that a run left. Raises RunError where it cannot be read, or is none of several views."""
    table = read_table(file, NEEDED)
    flat = {name: torch.from_numpy(table[name]) for name in NEEDED}
    columns = {name: column.reshape(-1, _views(file, flat)) for name, column in flat.items()}
    finite = torch.stack(list(columns.values())).isfinite().all(0).all(-1)
    if not bool(finite.any()):
        raise RunError(f"{file.name}: of no scene all predictions are finite; train longer")
    found = SeveralViews(columns).subset(finite)
    try:
        _ = found.predictions, found.pose
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise RunError(f"{file.name}: no predictions with poses ({reason}); {AGAIN}") from None
    return found


def _views(file: Path, flat: Mapping[str, Tensor]) -> int:
    """How many views each scene has. Raises RunError where not every scene has all of them, in order."""
    rows = torch.arange(len(flat["view"]), dtype=torch.float64)
    views = int(flat["view"].max()) + 1 if len(rows) else 0
    if views < 2 or len(rows) % views or not bool((flat["scene"] * views + flat["view"] == rows).all()):
        raise RunError(f"{file.name}: not every view of every scene, two or more, in order; {AGAIN}")
    return views
