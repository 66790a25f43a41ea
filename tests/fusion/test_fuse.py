"""Known solutions, invariances, and failures that leave their neighbours alone."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Plane, Pose, Status, fuse
from phd_exp.fusion.newton import LEAST_DEPTHS
from tests.support.random_problems import columns_of, random_problems, rotations


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def looking(towards: Tensor, at: Tensor) -> Pose:
    """Cameras at these places, turned to look along these directions."""
    z = torch.nn.functional.normalize(towards, dim=-1)
    up = torch.where(z[..., 1:2].abs() > 0.9, tensor(1, 0, 0), tensor(0, 1, 0))
    x = torch.nn.functional.normalize(torch.linalg.cross(up, z), dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=-2)
    return Pose(R, -(R @ at[..., None]).squeeze(-1))


def predicting(pose: Pose, where: Tensor, A: float = 200.0, a: float = 20.0) -> ProjectedHuber:
    """Each camera holds one position of the world most likely."""
    v = pose.into_camera(where)
    eye = A * torch.eye(2, dtype=torch.float64).expand(*v.shape[:-1], 2, 2)
    return ProjectedHuber(v[..., :2] / v[..., 2:], v[..., 2], eye, torch.full_like(v[..., 2], a))


def chosen(predictions: ProjectedHuber, pose: Pose, index: Any) -> tuple[ProjectedHuber, Pose]:
    """Some of the problems, or of their cameras."""
    columns = (column[index] for column in columns_of(predictions))
    return ProjectedHuber(*columns), Pose(pose.R[index], pose.t[index])


@pytest.mark.parametrize("cameras", [2, 3, 8])
def test_cameras_that_agree_are_right(cameras: int) -> None:
    """Then every depth sits at its kink, more of them than there are unknowns."""
    _, pose, truth = random_problems(200, cameras, seed=2)
    predictions = predicting(pose, truth[:, None])
    fused = fuse(predictions, pose)
    torch.testing.assert_close(fused.point, truth)
    assert (fused.status == Status.FUSED).all()


def test_the_optimum_and_its_covariance_lie_in_the_plane() -> None:
    predictions, pose, truth = random_problems(100, 3, seed=4)
    normal = tensor(0, 3, 4)
    plane = Plane(normal.expand(100, 3), truth @ normal)
    fused = fuse(predictions, pose, plane, contradiction=0.0)
    torch.testing.assert_close(fused.point @ normal, plane.offset)
    torch.testing.assert_close(fused.mean @ normal, plane.offset)
    assert (fused.covariance @ normal).abs().max() < 1e-12
    assert (torch.linalg.matrix_rank(fused.covariance, tol=1e-9) == 2).all()


def test_a_motion_of_the_world_moves_the_result() -> None:
    predictions, pose, truth = random_problems(200, 4, seed=5)
    R = rotations(1, torch.Generator().manual_seed(1))[0]
    shift = tensor(100, -50, 20)
    moved = Pose(pose.R @ R.T, pose.t - (pose.R @ R.T @ shift))
    for plane, moved_plane in (
        (None, None),
        (
            Plane(tensor(0, 1, 0).expand(200, 3), truth[:, 1]),
            Plane((R @ tensor(0, 1, 0)).expand(200, 3), truth[:, 1] + R[:, 1] @ shift),
        ),
    ):
        before = fuse(predictions, pose, plane, contradiction=0.0)
        after = fuse(predictions, moved, moved_plane, contradiction=0.0)
        torch.testing.assert_close(after.point, before.point @ R.T + shift, rtol=0, atol=1e-6)
        torch.testing.assert_close(after.surprise, before.surprise, rtol=0, atol=1e-5)
    torch.testing.assert_close(fuse(predictions, moved).status, fuse(predictions, pose).status)


def test_a_masked_camera_counts_nothing_whatever_it_holds() -> None:
    predictions, pose, _ = random_problems(200, 4, seed=7)
    mask = torch.ones(200, 4, dtype=torch.bool)
    mask[:, 1] = False
    *columns, R, t = (value.clone() for value in (*columns_of(predictions), pose.R, pose.t))
    for value in (*columns, R, t):
        value[:, 1] = torch.nan
    fused = fuse(ProjectedHuber(*columns, validate_args=False), Pose(R, t), mask=mask, contradiction=0.0)
    kept = [0, 2, 3]
    alone = fuse(*chosen(predictions, pose, (slice(None), kept)), contradiction=0.0)
    torch.testing.assert_close(fused.point, alone.point, rtol=0, atol=1e-9)
    torch.testing.assert_close(fused.covariance, alone.covariance)
    torch.testing.assert_close(fused.surprise[:, kept], alone.surprise)
    assert fused.surprise[:, 1].isnan().all()


def test_an_outlier_shows_and_the_others_do_not() -> None:
    _, pose, truth = random_problems(200, 6, seed=8)
    where = truth[:, None].repeat(1, 6, 1)
    where[:, 2] += 1
    fused = fuse(predicting(pose, where), pose)
    assert (fused.status == Status.FUSED).all()
    assert (fused.surprise.argmax(-1) == 2).all()
    assert (fused.surprise[:, 2] > 0.9).all()
    assert fused.surprise[:, [0, 1, 3, 4, 5]].median() < 0.1


def failing(kind: Status) -> tuple[ProjectedHuber, Pose, Plane, Tensor]:
    """Three problems of two cameras on the plane y = 0, of which the middle one fails in this way."""
    at = torch.stack([tensor(-1, -1, 0), tensor(1, -1, 0)]).repeat(3, 1, 1)
    where = tensor(0, 0, 4).expand(3, 2, 3).clone()
    towards, mask = where - at, torch.ones(3, 2, dtype=torch.bool)
    if kind is Status.NO_COMMON_VIEW:  # back to back
        towards[1] = torch.stack([tensor(-1, 0, 0), tensor(1, 0, 0)])
        where[1] = torch.stack([tensor(-5, 0, 0), tensor(5, 0, 0)])
    if kind is Status.PLANE_BEHIND_CAMERA:  # looking straight up, and y points down
        towards[1], where[1] = tensor(0, -1, 0), tensor(0, -5, 0)
    if kind is Status.CONTRADICTION:
        where[1, 1] = tensor(2, 0, 9)
    mask[1] = kind is not Status.NO_CAMERA
    pose = looking(towards, at)
    predictions = predicting(pose, where)
    R, a, normal = pose.R.clone(), predictions.a.clone(), tensor(0, 1, 0).expand(3, 3).clone()
    if kind is Status.NOT_FINITE:
        a[1, 0] = torch.nan
    if kind is Status.NOT_A_ROTATION:
        R[1, 1] *= 1.01
    if kind is Status.NOT_A_PLANE:
        normal[1] = 0
    predictions = ProjectedHuber(predictions.mu_xy, predictions.mu_z, predictions.A, a, validate_args=False)
    return predictions, Pose(R, pose.t), Plane(normal, torch.zeros(3, dtype=torch.float64)), mask


@pytest.mark.parametrize("kind", [kind for kind in Status if kind not in (Status.FUSED, Status.NOT_CONVERGED)])
def test_a_failure_is_named_and_leaves_its_neighbours_alone(kind: Status) -> None:
    predictions, pose, plane, mask = failing(kind)
    fused = fuse(predictions, pose, plane, mask)
    assert fused.status.tolist() == [Status.FUSED, kind, Status.FUSED]
    for value in (fused.point, fused.mean, fused.covariance, fused.subgradient, fused.surprise):
        assert value[1].isnan().all()
        assert value[[0, 2]].isfinite().all()
    torch.testing.assert_close(fused.point[0], tensor(0, 0, 4))
    assert fused.errors() == [f"problem 1: {kind.reason}"]


def test_a_common_view_is_found_where_there_is_one() -> None:
    """Cameras that look anywhere, against a linear program: the largest depth, up to 1 m, that all can reach."""
    generator = torch.Generator().manual_seed(2)
    n, cameras = 150, 5
    pose = Pose(
        rotations(n * cameras, generator).unflatten(0, (n, cameras)),
        2 * torch.randn(n, cameras, 3, generator=generator, dtype=torch.float64),
    )
    eye = torch.eye(2, dtype=torch.float64).expand(n, cameras, 2, 2)
    ahead = torch.full((n, cameras), 4.0, dtype=torch.float64)
    fused = fuse(ProjectedHuber(torch.zeros_like(eye[..., 0]), ahead, 30 * eye, ahead), pose, contradiction=0.0)
    reached = []
    for R, t in zip(pose.R.numpy(), pose.t.numpy(), strict=True):
        rows = np.concatenate([-R[:, 2], np.ones((cameras, 1))], axis=1)
        result = linprog([0, 0, 0, -1], A_ub=rows, b_ub=t[:, 2], bounds=[(None, None)] * 3 + [(None, 1)])
        reached.append(float(result.x[3]))
    feasible = torch.tensor(reached) > 0
    assert (torch.tensor(reached).abs() > 1e-4).all()  # none is too close to call
    assert 20 < feasible.sum() < n - 5
    assert fused.status.tolist() == [Status.FUSED if any_ else Status.NO_COMMON_VIEW for any_ in feasible]


@pytest.mark.parametrize("on_plane", [False, True])
def test_extreme_predictions_are_fused_too(on_plane: bool) -> None:
    """Precisions over five decades, modes a third or three times as far as the truth."""
    predictions, pose, truth = random_problems(2000, 3, seed=15, outliers=0.5)
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand(4, 2000, 3, generator=generator, dtype=torch.float64)
    mu_xy, mu_z, A, _ = columns_of(predictions)
    factor = 3 ** (2 * uniform[2] - 1)
    predictions = ProjectedHuber(
        mu_xy, mu_z * factor, A * 10 ** (3 * uniform[0] - 2)[..., None, None], 10 ** (5 * uniform[1] - 2)
    )
    plane = Plane(torch.ones(2000, 3, dtype=torch.float64), truth.sum(-1)) if on_plane else None
    fused = fuse(predictions, pose, plane, contradiction=0.0)
    assert (fused.status == Status.FUSED).all()
    assert (torch.linalg.eigvalsh(fused.covariance)[:, -1] > 0).all()


@pytest.mark.kernels
def test_failures_do_not_change_the_others() -> None:
    """Against the batch without them, up to the rounding errors of its matrix products."""
    predictions, pose, _ = random_problems(403, 3, seed=9)
    columns, R = columns_of(predictions), pose.R.clone()
    columns[3][5::7, 1], R[3::11, 0] = torch.nan, 2 * torch.eye(3, dtype=torch.float64)
    fused = fuse(ProjectedHuber(*columns, validate_args=False), Pose(R, pose.t))
    broken = (fused.status == Status.NOT_FINITE) | (fused.status == Status.NOT_A_ROTATION)
    kept = (~broken).nonzero().squeeze(-1)
    assert len(kept) == 403 - len({*range(5, 403, 7), *range(3, 403, 11)})
    alone = fuse(*chosen(predictions, pose, kept))
    assert torch.equal(fused.status[kept], alone.status)
    for name in ("point", "mean", "covariance", "surprise"):
        one, other = getattr(fused, name)[kept], getattr(alone, name)
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("shape", [(0,), (2, 0)])
def test_an_empty_batch_gives_empty_results(shape: tuple[int, ...]) -> None:
    predictions, pose, _ = random_problems(1, 3, seed=16)
    none = ProjectedHuber(*(c.expand(*shape, *c.shape[1:]) for c in columns_of(predictions)))
    for plane in (None, Plane(tensor(0, 1, 0), tensor(1).squeeze())):
        fused = fuse(none, Pose(pose.R[0], pose.t[0]), plane)
        assert fused.point.shape == fused.mean.shape == (*shape, 3)
        assert fused.covariance.shape == (*shape, 3, 3)
        assert fused.surprise.shape == (*shape, 3)
        assert fused.errors() == []


def test_float32_is_taken_and_batches_have_any_shape() -> None:
    predictions, pose, _ = random_problems(6, 3, seed=11, outliers=0.0)
    columns = [column.float().unflatten(0, (2, 3)) for column in (*columns_of(predictions), pose.R, pose.t)]
    fused = fuse(ProjectedHuber(*columns[:4]), Pose(*columns[4:]))
    reference = fuse(predictions, pose)
    assert fused.point.shape == (2, 3, 3)
    assert fused.covariance.shape == (2, 3, 3, 3)
    assert fused.point.dtype == torch.float64
    torch.testing.assert_close(fused.point.flatten(0, 1), reference.point, rtol=0, atol=1e-4)
    single = fuse(ProjectedHuber(*(c[0, 0] for c in columns[:4])), Pose(*(c[0, 0] for c in columns[4:])))
    assert single.point.shape == (3,)
    assert single.errors() == []
    torch.testing.assert_close(single.point, fused.point[0, 0])


def test_the_search_may_start_behind_a_camera() -> None:
    """The average of the predicted positions lies behind the second camera, far from where both look."""
    at = torch.stack([tensor(0, 0, 0), tensor(0, 0, 3.5)])
    pose = looking(tensor(0, 0, 1).expand(2, 3), at)
    predictions = predicting(pose, torch.stack([tensor(0, 0, 0.5), tensor(0, 0, 5)]), a=3.0)
    fused = fuse(predictions, pose, contradiction=0.0)
    assert (pose.into_camera(fused.point)[:, 2] > 0).all()
    assert fused.status == Status.FUSED


@pytest.mark.parametrize("gap", [1e-1, 3e-3, 3e-5])
def test_an_optimum_may_be_just_in_front_of_a_camera(gap: float) -> None:
    """Two cameras face each other, and the first is sure of a place just before the second."""
    assert min(LEAST_DEPTHS) < gap
    at = torch.stack([tensor(0, 0, 0), tensor(0, 0, 4 + gap)])
    pose = looking(torch.stack([tensor(0, 0, 1), tensor(0, 0, -1)]), at)
    predictions = predicting(pose, torch.stack([tensor(0, 0, 4), tensor(0, 0, 3 + gap)]))
    a = torch.stack([tensor(2 / gap**2, 1e-3)]).squeeze(0)
    predictions = ProjectedHuber(predictions.mu_xy, predictions.mu_z, predictions.A, a)
    fused = fuse(predictions, pose, contradiction=0.0)
    torch.testing.assert_close(fused.point, tensor(0, 0, 4), rtol=0, atol=1e-9)


def test_shapes_that_do_not_fit_are_refused() -> None:
    predictions, pose, _ = random_problems(4, 3, seed=12)
    with pytest.raises(ValueError, match=r"pose.R: got batch shape \(3, 3\); .* to \(4, 3\)"):
        fuse(predictions, Pose(pose.R[:3], pose.t[:3]))
    with pytest.raises(ValueError, match=r"got batch shape \(\); expected \(\*problems, cameras\)"):
        fuse(*chosen(predictions, pose, (0, 0)))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_gpu_finds_the_same() -> None:
    predictions, pose, _ = random_problems(1000, 4, seed=13)
    columns = columns_of(predictions)
    on_gpu = fuse(ProjectedHuber(*(column.cuda() for column in columns)), Pose(pose.R.cuda(), pose.t.cuda()))
    fused = fuse(predictions, pose)
    torch.testing.assert_close(on_gpu.point.cpu(), fused.point, rtol=0, atol=1e-6, equal_nan=True)
    torch.testing.assert_close(on_gpu.covariance.cpu(), fused.covariance, rtol=1e-6, atol=1e-9, equal_nan=True)
