"""Does fusion pay? Errors and calibration of several ways to fuse what a run says of several views."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from scipy import stats
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.evaluation.point_errors import SEED
from phd_exp.evaluation.predictions import band_of
from phd_exp.evaluation.reference import Band
from phd_exp.evaluation.several_views import SeveralViews
from phd_exp.fusion import Fused, Plane, Pose, Status, average, fuse, gaussian_fusion
from phd_exp.metrics.bootstrap import bands, means
from phd_exp.metrics.errors import MILLIMETRES, depth_error, squared_mahalanobis
from phd_exp.records.errors import RunError

Method = Literal["mode", "mean", "average", "gaussian"]
"""Projected Huber fusion, its mode and its mean; the average of the modes; inverse-covariance fusion."""
METHODS: tuple[Method, ...] = ("mode", "mean", "average", "gaussian")
PROBABILISTIC: tuple[Method, ...] = ("mean", "gaussian")
"""Those with a covariance."""
LEVELS = (50, 90, 99)
"""Per cent of the ellipsoids whose coverage is counted."""
ERRORS = ("depth_error_mm", "distance_mm")
CALIBRATION = (*(f"coverage_{level}" for level in LEVELS), "normalised_squared_error")
BINS = 20


@dataclass(frozen=True)
class FusionScores:
    """What the first 1, 2, ... cameras of each scene give together.

    Attributes:
        n, views: scenes and cameras of each.
        left_out: further scenes with something that is not finite or cannot be fused.
        bands: by `place`, means over scenes with their 95 % bootstrap intervals. `depth_error_mm` is along the first
            camera's true viewing ray, `distance_mm` in space; `coverage_50` is the share (per cent) of true positions
            within the ellipsoid of mean and covariance that holds so much of a Gaussian; `normalised_squared_error`
            the squared Mahalanobis distance over the number of dimensions, 1 on average where calibrated.
        surprise: counts of the views in which the fused position of all cameras has a credible level in each of
            `BINS` equal parts of [0, 1].
        correlation: between the errors of log depth of two views of a scene (intraclass).
        with_size: correlation of that error, averaged over views, with log size.
        exact: by `place`, the coverage that exact densities have: their tails are longer than a Gaussian's.
    """

    n: int
    views: int
    left_out: int
    bands: dict[str, Band]
    surprise: list[int]
    correlation: Band
    with_size: Band
    exact: dict[str, float]

    def band(self, quantity: str, method: Method, cameras: int, on_plane: bool = False) -> Band:
        """What the first so many cameras give, fused by a method, on the ground or not."""
        return self.bands[place(quantity, method, cameras, on_plane)]


def place(quantity: str, method: str, cameras: int, on_plane: bool) -> str:
    """The key of a number."""
    return f"{quantity}/{method}/{cameras}/{'ground' if on_plane else 'free'}"


@dataclass(frozen=True)
class Estimate:
    """Positions in the world, metres; mean and covariance of a method that has them."""

    point: Float[Tensor, "scenes 3"]
    covariance: Float[Tensor, "scenes 3 3"] | None = None


def fusion_scores(views: SeveralViews, resamples: int = 200) -> FusionScores:
    """Fuse and measure. Raises RunError where no scene can be fused by every method."""
    fused = {(k, on_plane): _fused(views, k, on_plane) for k, on_plane in _places(views.views)}
    sound = torch.stack([found.status == Status.FUSED for found in fused.values()]).all(0)
    sound &= torch.stack([found.covariance.isfinite().all(-1).all(-1) for found in fused.values()]).all(0)
    if not bool(sound.any()):
        raise RunError("several views: not one scene can be fused; train longer")
    kept = views.subset(sound)
    found: dict[str, Band] = {}
    exact: dict[str, float] = {}
    for (k, on_plane), result in fused.items():
        estimates = _estimates(kept.cameras(k), kept.ground if on_plane else None, result, sound)
        columns = _columns(kept, estimates, on_plane)
        for (quantity, method), band in _bands(columns, resamples).items():
            found[place(quantity, method, k, on_plane)] = band
        shares = result.coverage([level / 100 for level in LEVELS])[sound].mean(0)
        for level, share in zip(LEVELS, shares.tolist(), strict=True):
            exact[place(f"coverage_{level}", "mean", k, on_plane)] = 100 * share
    correlation, with_size = _common_cause(kept, resamples)
    surprise = fused[views.views, False].surprise[sound].flatten()
    return FusionScores(
        n=kept.n,
        views=kept.views,
        left_out=kept.left_out,
        bands=found,
        surprise=[int(count) for count in torch.histc(surprise, BINS, 0, 1)],
        correlation=correlation,
        with_size=with_size,
        exact=exact,
    )


def _places(views: int) -> list[tuple[int, bool]]:
    return [(k, on_plane) for on_plane in (False, True) for k in range(1, views + 1)]


def _fused(views: SeveralViews, k: int, on_plane: bool) -> Fused:
    """However much its views contradict one another, no scene is refused: that would spare ours its worst errors."""
    seen = views.cameras(k)
    return fuse(seen.predictions, seen.pose, views.ground if on_plane else None, contradiction=0.0)


def _estimates(
    seen: SeveralViews, plane: Plane | None, fused: Fused, sound: Tensor
) -> dict[Method, Estimate]:
    point, mean, covariance = (values[sound] for values in (fused.point, fused.mean, fused.covariance))
    averaged = average(seen.pose.into_world(seen.predictions.mode))
    try:
        gaussian = gaussian_fusion(*world_moments(seen.predictions, seen.pose))
    except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
        raise RunError(f"several views: a covariance is singular ({error}); train longer") from None
    if plane is not None:
        averaged, gaussian = plane.nearest(averaged), conditioned(*gaussian, plane)
    return {
        "mode": Estimate(point),
        "mean": Estimate(mean, covariance),
        "average": Estimate(averaged),
        "gaussian": Estimate(*gaussian),
    }


def world_moments(
    predictions: ProjectedHuber, pose: Pose
) -> tuple[Float[Tensor, "*views 3"], Float[Tensor, "*views 3 3"]]:
    """Mean (m) and covariance (m^2) of each view's density in the world: R^T (mean - t) and R^T C R."""
    return pose.into_world(predictions.mean), pose.R.mT @ predictions.covariance_matrix @ pose.R


def conditioned(
    mean: Float[Tensor, "scenes 3"], covariance: Float[Tensor, "scenes 3 3"], plane: Plane
) -> tuple[Float[Tensor, "scenes 3"], Float[Tensor, "scenes 3 3"]]:
    """A Gaussian given that n . v = c: v - C n (n . v - c) / (n . C n) and C - C n n^T C / (n . C n).

    Source: conditioning of a Gaussian on a linear observation without noise; checked against a narrow one in
    tests/evaluation/test_fusion.py.
    """
    Cn = (covariance @ plane.normal[..., None]).squeeze(-1)
    variance = (plane.normal * Cn).sum(-1)[..., None]
    excess = ((plane.normal * mean).sum(-1) - plane.offset)[..., None]
    outer = Cn[..., :, None] * Cn[..., None, :]
    return mean - Cn * excess / variance, covariance - outer / variance[..., None]


def _columns(
    views: SeveralViews, estimates: Mapping[Method, Estimate], on_plane: bool
) -> dict[tuple[str, Method], Tensor]:
    """A number a scene."""
    columns: dict[tuple[str, Method], Tensor] = {}
    xyz, truth = views.xyz[:, 0], views.truth
    for method, estimate in estimates.items():
        seen = views.first.into_camera(estimate.point)
        columns["depth_error_mm", method] = MILLIMETRES * depth_error(xyz, seen)
        columns["distance_mm", method] = MILLIMETRES * (estimate.point - truth).norm(dim=-1)
        if estimate.covariance is not None:
            along = views.ground.directions if on_plane else None
            distance = squared_mahalanobis(truth - estimate.point, estimate.covariance, along)
            within = _within(distance, 2 if on_plane else 3)
            columns |= {(name, method): column for name, column in within.items()}
    return columns


def _within(distance: Float[Tensor, " scenes"], dimensions: int) -> dict[str, Tensor]:
    bounds = {level: float(stats.chi2.ppf(level / 100, dimensions)) for level in LEVELS}
    inside = {f"coverage_{level}": 100.0 * (distance <= bound) for level, bound in bounds.items()}
    return inside | {"normalised_squared_error": distance / dimensions}


def _bands(columns: Mapping[tuple[str, Method], Tensor], resamples: int) -> dict[tuple[str, Method], Band]:
    named = {"/".join(key): column for key, column in columns.items()}
    found = bands(means, named, resamples, SEED)
    return {key: band_of(found["/".join(key)]) for key in columns}


def _common_cause(views: SeveralViews, resamples: int) -> tuple[Band, Band]:
    """Correlation of the errors of log depth of two views of a scene, and of their average with log size."""
    error = (views.predictions.mu_z / views.xyz[..., 2]).log()
    columns = {
        "mean": error.mean(-1),
        "variance": error.var(-1),
        "size": views.columns["scale"][:, 0].log(),
        "views": torch.full((views.n,), views.views, dtype=torch.float64),
    }
    found = bands(_correlations, columns, resamples, SEED)
    return band_of(found["of_views"]), band_of(found["with_size"])


def _correlations(columns: Mapping[str, Tensor], counts: Tensor) -> dict[str, Tensor]:
    """The intraclass correlation between / (between + within), and Pearson's with log size.

    Of scenes with k views each, within is the mean of their variances, and between the variance of their means
    less within / k. Source: Fisher's one-way analysis of variance; checked in tests/evaluation/test_fusion.py.
    """
    share = counts / counts.sum(-1, keepdim=True)
    mean, size = columns["mean"], columns["size"]

    def covariance(x: Tensor, y: Tensor) -> Tensor:
        return share @ (x * y) - (share @ x) * (share @ y)

    within = share @ columns["variance"]
    between = covariance(mean, mean) - within / columns["views"][0]
    pearson = covariance(mean, size) / (covariance(mean, mean) * covariance(size, size)).sqrt()
    return {"of_views": between / (between + within), "with_size": pearson}
