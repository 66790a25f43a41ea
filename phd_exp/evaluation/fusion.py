"""Compares ways to fuse several views of a scene: errors and calibration of the fused positions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from scipy import stats
from torch import Tensor

from phd_exp.evaluation.predictions import Evaluation, evaluation_of, scalar_bands
from phd_exp.evaluation.several_views import SeveralViews
from phd_exp.fusion import Fused, Plane, Status, average, fuse, fuse_shared, gaussian_fusion
from phd_exp.metrics.bootstrap import Interval, means
from phd_exp.metrics.errors import MILLIMETRES, depth_error, squared_mahalanobis
from phd_exp.records.errors import RunError

Method = Literal["mode", "mean", "shared", "average", "gaussian"]
"""Projected Huber fusion, its mode, its mean, and its mean by `fuse_shared`; the average of the modes;
inverse-covariance fusion."""
METHODS: tuple[Method, ...] = ("mode", "mean", "shared", "average", "gaussian")
PROBABILISTIC: tuple[Method, ...] = ("mean", "shared", "gaussian")  # the methods with a covariance
PER_CENT = (50, 90, 99)  # per cent of the ellipsoids whose coverage is counted
ERRORS = ("depth_error_mm", "distance_mm")
CALIBRATION = (*(f"coverage_{level}" for level in PER_CENT), "normalised_squared_error")
BINS = 20
MOST_SHARED = 0.99


@dataclass(frozen=True)
class FusionScores:
    """Scores of fusing the first 1, 2, ... cameras of each scene.

    Attributes:
        n, views: number of scenes, and of cameras per scene.
        left_out: further scenes, with a value that is not finite or without a fused position.
        bands: by `place`, means over scenes with 95 % bootstrap intervals. `depth_error_mm` is along the first
            camera's true viewing ray, `distance_mm` in space; `coverage_50` is the share (per cent) of true positions
            in the ellipsoid of mean and covariance that contains 50 % of a Gaussian; `normalised_squared_error` is
            the squared Mahalanobis distance over the number of dimensions, 1 on average if calibrated.
        surprise: a histogram over the views, in `BINS` equal parts of [0, 1], of the credible level that each view
            gives the position fused from all cameras.
        correlation: intraclass correlation of the views' errors of log depth.
        with_size: correlation of that error, averaged over views, with log size.
        exact: by `place`, the coverage of the exact densities, whose tails are longer than a Gaussian's.
    """

    n: int
    views: int
    left_out: int
    bands: dict[str, Interval[float]]
    surprise: list[int]
    correlation: Interval[float]
    with_size: Interval[float]
    exact: dict[str, float]

    def band(self, quantity: str, method: Method, cameras: int, on_plane: bool = False) -> Interval[float]:
        """The score of the first `cameras` fused by a method, on the ground or in free space."""
        return self.bands[place(quantity, method, cameras, on_plane)]


def place(quantity: str, method: str, cameras: int, on_plane: bool) -> str:
    """The key of a number."""
    return f"{quantity}/{method}/{cameras}/{'ground' if on_plane else 'free'}"


def fusion_scores(views: SeveralViews, resamples: int = 200) -> FusionScores:
    """Fuse with every method and score. Raises RunError if no scene can be fused by all of them.

    No scene is refused for views that contradict each other (`contradiction=0`): that would remove the largest
    errors.
    """
    fused = _fused(views)
    every = [found for ways in fused.values() for found in ways.values()]
    sound = torch.stack([found.status == Status.FUSED for found in every]).all(0)
    sound &= torch.stack([found.covariance.isfinite().all(-1).all(-1) for found in every]).all(0)
    if not bool(sound.any()):
        raise RunError("several views: not one scene can be fused; train longer")
    kept = views.subset(sound)
    columns: dict[str, Tensor] = {}
    exact: dict[str, float] = {}
    for (k, on_plane), ways in fused.items():
        estimates = _baselines(kept.cameras(k), kept.ground if on_plane else None)
        estimates["mode"] = ways["mean"].point[sound], None
        estimates |= {name: (found.mean[sound], found.covariance[sound]) for name, found in ways.items()}
        for method in METHODS:
            for quantity, column in _columns(kept, *estimates[method], on_plane).items():
                columns[place(quantity, method, k, on_plane)] = column
        shares = ways["mean"].coverage([level / 100 for level in PER_CENT])[sound].mean(0)
        for level, share in zip(PER_CENT, shares.tolist(), strict=True):
            exact[place(f"coverage_{level}", "mean", k, on_plane)] = 100 * share
    causes = scalar_bands(_correlations, _depth_errors(kept), resamples)
    surprise = fused[views.views, False]["mean"].surprise[sound].flatten()
    return FusionScores(
        n=kept.n,
        views=kept.views,
        left_out=kept.left_out,
        bands=scalar_bands(means, columns, resamples),
        surprise=[int(count) for count in torch.histc(surprise, BINS, 0, 1)],
        correlation=causes["of_views"],
        with_size=causes["with_size"],
        exact=exact,
    )


def two_cameras(views: SeveralViews, resamples: int = 200) -> Evaluation:
    """The error of the mean of the first two cameras' product, `fused_error_mm`, a distance in space.

    The product is that of Projected Huber densities, or of Gaussians with the moments of other densities. Raises
    RunError if no scene can be fused.
    """
    pair = views.cameras(2)
    if pair.is_huber:
        point = fuse(pair.predictions, pair.pose, contradiction=0.0).mean
    else:
        point = gaussian_fusion(*pair.world_moments)[0]
    error = MILLIMETRES * (point - pair.truth).norm(dim=-1)
    finite = error.isfinite()
    if not bool(finite.any()):
        raise RunError("several views: not one scene can be fused; train longer")
    return evaluation_of(means, {"fused_error_mm": error[finite]}, views.left_out + int((~finite).sum()), resamples)


def _fused(views: SeveralViews) -> dict[tuple[int, bool], dict[Method, Fused]]:
    """By number of cameras and whether on the ground, and by method; the shared part is that of the other half."""
    half = torch.arange(views.n) % 2
    share = shared_share(views, torch.stack([half == 1, half == 0]))[half]
    fused: dict[tuple[int, bool], dict[Method, Fused]] = {}
    for on_plane in (False, True):
        for k in range(1, views.views + 1):
            part, plane = views.cameras(k), views.ground if on_plane else None
            problem = part.predictions, part.pose, plane, None, 0.0
            fused[k, on_plane] = {"mean": fuse(*problem), "shared": fuse_shared(*problem, share=share)}
    return fused


def _baselines(views: SeveralViews, plane: Plane | None) -> dict[Method, tuple[Tensor, Tensor | None]]:
    """Position and covariance in the world by the methods that do not use the Projected Huber density."""
    averaged = average(views.pose.into_world(views.predictions.mode))
    try:
        gaussian = gaussian_fusion(*views.world_moments)
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise RunError(f"several views: a covariance is singular ({error}); train longer") from None
    if plane is not None:
        averaged, gaussian = plane.nearest(averaged), conditioned(*gaussian, plane)
    return {"average": (averaged, None), "gaussian": gaussian}


def conditioned(
    mean: Float[Tensor, "scenes 3"], covariance: Float[Tensor, "scenes 3 3"], plane: Plane
) -> tuple[Float[Tensor, "scenes 3"], Float[Tensor, "scenes 3 3"]]:
    """A Gaussian given that n . v = c: v - C n (n . v - c) / (n . C n) and C - C n n^T C / (n . C n).

    Source: conditioning of a Gaussian on a linear observation without noise, checked as the limit of small noise in
    tests/evaluation/test_fusion.py.
    """
    Cn = (covariance @ plane.normal[..., None]).squeeze(-1)
    variance = (plane.normal * Cn).sum(-1)[..., None]
    excess = ((plane.normal * mean).sum(-1) - plane.offset)[..., None]
    outer = Cn[..., :, None] * Cn[..., None, :]
    return mean - Cn * excess / variance, covariance - outer / variance[..., None]


def _columns(
    views: SeveralViews, point: Tensor, covariance: Tensor | None, on_plane: bool
) -> dict[str, Float[Tensor, " scenes"]]:
    """One number per scene for each quantity."""
    error = point - views.truth
    columns = {
        "depth_error_mm": MILLIMETRES * depth_error(views.xyz[:, 0], views.first.into_camera(point)),
        "distance_mm": MILLIMETRES * error.norm(dim=-1),
    }
    if covariance is not None:
        dimensions = 2 if on_plane else 3
        distance = squared_mahalanobis(-error, covariance, views.ground.directions if on_plane else None)
        for level in PER_CENT:
            columns[f"coverage_{level}"] = 100.0 * (distance <= stats.chi2.ppf(level / 100, dimensions))
        columns["normalised_squared_error"] = distance / dimensions
    return columns


def shared_share(views: SeveralViews, chosen: Bool[Tensor, "*sets scenes"]) -> Float[Tensor, "*sets"]:
    """The `share` of `fuse_shared` that the chosen scenes have, their intraclass correlation; 0 without scenes."""
    return _correlations(_depth_errors(views), chosen.double())["of_views"].nan_to_num().clamp(0, MOST_SHARED)


def _depth_errors(views: SeveralViews) -> dict[str, Tensor]:
    error = (views.predictions.mu_z / views.xyz[..., 2]).log()
    return {
        "mean": error.mean(-1),
        "variance": error.var(-1),
        "size": views.columns["scale"][:, 0].log(),
        "views": torch.full((views.n,), views.views, dtype=torch.float64),
    }


def _correlations(columns: Mapping[str, Tensor], counts: Tensor) -> dict[str, Tensor]:
    """The intraclass correlation between / (between + within), and Pearson's correlation with log size.

    For scenes with k views, within is the mean of their variances; between is the variance of their means minus
    within / k. Source: Fisher's one-way analysis of variance; checked in tests/evaluation/test_fusion.py.
    """
    share = counts / counts.sum(-1, keepdim=True)
    mean, size = columns["mean"], columns["size"]

    def covariance(x: Tensor, y: Tensor) -> Tensor:
        return share @ (x * y) - (share @ x) * (share @ y)

    within = share @ columns["variance"]
    between = covariance(mean, mean) - within / columns["views"][0]
    pearson = covariance(mean, size) / (covariance(mean, mean) * covariance(size, size)).sqrt()
    return {"of_views": between / (between + within), "with_size": pearson}
