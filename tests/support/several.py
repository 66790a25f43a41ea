"""Records of several views whose calibration is known."""

from pathlib import Path

import torch
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.fusion import Pose
from phd_exp.records import scenes
from phd_exp.rendering.sampling import about_axis
from phd_exp.training.predictions import columns, write_parquet
from tests.support.synthetic import calibrated, truths

ANGLES = (0.0, 0.5, -0.6, 0.7)
"""Rotations of the cameras relative to the first, each about another axis."""


def write_views(
    file: Path, n: int = 400, *, a: float = 60.0, A: float = 600.0, overconfidence: float = 1.0, common: float = 0.0
) -> None:
    """`n` scenes seen by four cameras that predict each on its own; `common` is the log scale all depths share."""
    xyz, f = truths(4 * n, seed=5)
    random = torch.Generator().manual_seed(3)
    scale = torch.exp(common * torch.randn(n, generator=random, dtype=torch.float64))
    poses = [_pose(xyz[4 * (row // 4)], xyz[row], row % 4) for row in range(4 * n)]
    prediction = calibrated(xyz, a, A, overconfidence, seed=7)
    if common:
        prediction = _grown(prediction, scale.repeat_interleave(4))
    image = torch.zeros(4 * n, 1, 1, 3, dtype=torch.uint8)
    table = columns(prediction, Batch(image, xyz, f, S=224.0, row=torch.arange(4 * n)))
    numbers = [(*pose.rotation, *pose.translation) for pose in poses]
    known = {
        "file_name": [f"{row:06d}.png" for row in range(4 * n)],
        "scale": (1 / scale).repeat_interleave(4).tolist(),
        "scene": [row // 4 for row in range(4 * n)],
        "view": [row % 4 for row in range(4 * n)],
    }
    known |= dict(zip((*ROTATION, *TRANSLATION), map(list, zip(*numbers, strict=True)), strict=True))
    write_parquet(file, table, known)


def _grown(p: ProjectedHuber, scale: Tensor) -> ProjectedHuber:
    return ProjectedHuber(p.mu_xy, p.mu_z * scale, p.A, p.a)


def _pose(first: Tensor, seen: Tensor, view: int) -> scenes.Pose:
    """Of a camera that has at `seen` what the first has at `first`."""
    if view == 0:
        return scenes.FIRST_VIEW
    axis = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0))[view - 1]
    rotation = about_axis(axis, ANGLES[view])
    R = Pose.from_scene([scenes.Pose(rotation=rotation, translation=(0.0, 0.0, 0.0))]).R[0]
    x, y, z = (seen - R @ first).tolist()
    return scenes.Pose(rotation=rotation, translation=(x, y, z))
