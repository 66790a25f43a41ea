"""Each step of fusion the way its device is best at: compiled on a CPU, in batches elsewhere."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.fusion import certificate, newton
from phd_exp.fusion import moments as sampling
from phd_exp.fusion import polish as polishing
from phd_exp.fusion.certificate import Certificate
from phd_exp.fusion.energy import surprise as batched_surprise
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.views import Unknown, Views

# `phd_exp.fusion.compiled` is imported where it is used: numba takes a second, or more where nothing is compiled yet

Multipliers = Float[Tensor, "cameras problems"]


def soundness(
    problems: Problems,
) -> tuple[Bool[Tensor, "problems cameras"], Bool[Tensor, "problems cameras"]]:
    """See `Problems.sound` and `Pose.is_rigid`."""
    if problems.a.device.type != "cpu":
        return problems.sound, problems.pose.is_rigid
    from phd_exp.fusion.compiled import posing

    sound, rigid = np.empty((2, *problems.a.shape), dtype=bool)
    posing.soundness(
        _array(problems.to_seen),
        _array(problems.mode),
        _array(problems.a),
        _array(problems.pose.R),
        _array(problems.pose.t),
        sound,
        rigid,
    )
    return torch.from_numpy(sound), torch.from_numpy(rigid)


def views(problems: Problems) -> Views:
    """See `Problems.views`."""
    if problems.a.device.type != "cpu":
        return problems.views()
    from phd_exp.fusion.compiled import posing

    slope, at_origin = np.empty((*problems.a.shape, 3, 3)), np.empty((*problems.a.shape, 3))
    posing.views(
        _array(problems.to_seen),
        _array(problems.pose.R),
        _array(problems.pose.t),
        _array(problems.mask),
        _array(problems.origin),
        _array(problems.directions),
        slope,
        at_origin,
    )
    return Views(
        torch.from_numpy(slope).permute(2, 3, 1, 0)[:, : problems.directions.shape[-1]],
        torch.from_numpy(at_origin).permute(2, 1, 0),
        torch.where(problems.mask, problems.a, 0).T,
    )


def minimise(views: Views, u: Unknown, least: float) -> tuple[Unknown, Multipliers]:
    """See `newton.minimise`."""
    if views.a.device.type != "cpu":
        return newton.minimise(views, u, least)
    from phd_exp.fusion.compiled import newton as compiled

    result, lam = _unknowns(u), np.zeros(views.a.T.shape)
    compiled.minimise(*_arrays(views), result, lam, least)
    return _columns(result)[: len(u)], _columns(lam)


def polish(views: Views, u: Unknown, lam: Multipliers) -> tuple[Unknown, Multipliers]:
    """See `polish.polish`."""
    if views.a.device.type != "cpu":
        return polishing.polish(views, u, lam)
    from phd_exp.fusion.compiled import polish as compiled

    result, multipliers = _unknowns(u), _rows(lam).copy()
    compiled.polish(*_arrays(views), result, multipliers)
    return _columns(result)[: len(u)], _columns(multipliers)


def certify(views: Views, u: Unknown, lam: Multipliers) -> Certificate:
    """See `certificate.certify`."""
    if views.a.device.type != "cpu":
        return certificate.certify(views, u, lam)
    from phd_exp.fusion.compiled import certificate as compiled

    results = np.empty((3, u.shape[1]))
    compiled.certify(*_arrays(views), _unknowns(u), _rows(lam), *results)
    return Certificate(*torch.from_numpy(results))


def surprise(views: Views, u: Unknown) -> Float[Tensor, "cameras problems"]:
    """See `energy.surprise`."""
    if views.a.device.type != "cpu":
        return batched_surprise(views, u)
    from phd_exp.fusion.compiled import level as compiled

    level = np.empty(views.a.T.shape)
    compiled.surprise(*_arrays(views), _unknowns(u), level)
    return _columns(level)


def moments(views: Views, u: Unknown) -> tuple[Unknown, Float[Tensor, "k k problems"]]:
    """See `moments.moments`."""
    if views.a.device.type != "cpu":
        return sampling.moments(views, u)
    from phd_exp.fusion.compiled import moments as compiled

    k, n = u.shape
    mean, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    points, log_density = sampling.student_points(k)
    compiled.moments(
        *_arrays(views), _unknowns(u), _unknowns(points).T.copy(), log_density.numpy(), mean, covariance
    )
    return _columns(mean)[:k], torch.from_numpy(covariance).permute(1, 2, 0)[:k, :k]


def _arrays(views: Views) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope, by three unknowns, view of the origin and precision, the problems first."""
    slope, at_origin = _of_three(views.slope.permute(3, 2, 0, 1)), views.at_origin.permute(2, 1, 0)
    return _array(slope), _array(at_origin), _rows(views.a)


def _array(values: Tensor) -> np.ndarray:
    """Without gaps, as what is compiled expects it."""
    array: np.ndarray = values.contiguous().numpy()
    return array


def _rows(columns: Float[Tensor, "n problems"]) -> Float[np.ndarray, "problems n"]:
    """The problems first."""
    return _array(columns.T)


def _unknowns(columns: Unknown) -> Float[np.ndarray, "problems 3"]:
    """The problems first, a copy; the third one is 0 where there are two."""
    rows: np.ndarray = _of_three(columns.T).clone(memory_format=torch.contiguous_format).numpy()
    return rows


def _of_three(values: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch 3"]:
    return values if values.shape[-1] == 3 else torch.nn.functional.pad(values, (0, 1))


def _columns(rows: Float[np.ndarray, "problems n"]) -> Float[Tensor, "n problems"]:
    """The problems last."""
    return torch.from_numpy(rows).T
