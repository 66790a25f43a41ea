"""Scores of fusion on records whose calibration is known, and against independent formulas."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from phd_exp.distributions.columns import PARAMETERS, from_columns
from phd_exp.evaluation.fusion import BINS, METHODS, FusionScores, Method, conditioned, fusion_scores, two_cameras
from phd_exp.evaluation.several_views import read_views
from phd_exp.fusion import Plane
from phd_exp.records.errors import RunError
from tests.support.several import write_views

N = 300
SPREAD = 4 / np.sqrt(N)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("views")


@pytest.fixture(scope="module")
def calibrated(folder: Path) -> Path:
    write_views(folder / "calibrated.parquet", N)
    return folder / "calibrated.parquet"


@pytest.fixture(scope="module")
def scores(calibrated: Path) -> FusionScores:
    return fusion_scores(read_views(calibrated), resamples=50)


@pytest.fixture(scope="module")
def overconfident(folder: Path) -> FusionScores:
    write_views(folder / "overconfident.parquet", N, overconfidence=2.0)
    return fusion_scores(read_views(folder / "overconfident.parquet"), resamples=50)


def value(scores: FusionScores, quantity: str, method: Method, cameras: int, on_plane: bool = False) -> float:
    return scores.band(quantity, method, cameras, on_plane).value


@pytest.mark.parametrize("on_plane", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 3, 4])
@pytest.mark.parametrize("method", ["mean", "shared", "gaussian"])
def test_fused_calibrated_views_are_calibrated(
    scores: FusionScores, method: Method, cameras: int, on_plane: bool
) -> None:
    """The normalised squared error scatters by about 1/sqrt(N), a share p of N by sqrt(p (1 - p) / N)."""
    error = value(scores, "normalised_squared_error", method, cameras, on_plane)
    assert error == pytest.approx(1, abs=SPREAD)
    for level in (50, 90, 99):
        at = f"coverage_{level}/{method}/{cameras}/{'ground' if on_plane else 'free'}"
        slack = 400 * np.sqrt(0.01 * level * (1 - 0.01 * level) / N)
        # the fused Gaussian comes closer to its nominal coverage than the exact density
        low, high = sorted((level, scores.exact.get(at, level) if method == "mean" else level))
        slack += 0 if method == "mean" else 3
        assert low - slack < value(scores, f"coverage_{level}", method, cameras, on_plane) < high + slack


def test_exact_densities_have_shorter_ellipsoids_and_every_view_counts_once(scores: FusionScores) -> None:
    assert scores.exact["coverage_90/mean/1/free"] == pytest.approx(87.8, abs=0.7)
    assert scores.exact["coverage_90/mean/4/free"] == pytest.approx(88.8, abs=0.7)
    assert (len(scores.surprise), sum(scores.surprise)) == (BINS, N * 4)


def test_the_error_of_two_cameras_is_that_of_the_product_or_of_its_gaussian(
    scores: FusionScores, calibrated: Path, folder: Path
) -> None:
    def error(file: Path) -> float:
        return two_cameras(read_views(file), resamples=2).scores["fused_error_mm"].value

    assert error(calibrated) == pytest.approx(value(scores, "distance_mm", "mean", 2))
    table = pd.read_parquet(calibrated)
    density = from_columns({name: torch.tensor(table[name].to_numpy()) for name in PARAMETERS})
    covariance = density.covariance_matrix
    for i, x in enumerate("xyz"):
        table[f"mean_{x}"] = density.mean[:, i]
        for j, y in list(enumerate("xyz"))[i:]:
            table[f"C_{x}{y}"] = covariance[:, i, j]
    other = folder / "moments.parquet"
    table.drop(columns=list(PARAMETERS)).to_parquet(other)
    assert error(other) == pytest.approx(value(scores, "distance_mm", "gaussian", 2))
    with pytest.raises(RunError, match="no column mu_x"):
        fusion_scores(read_views(other))


def test_overconfident_views_are_detected(overconfident: FusionScores) -> None:
    """All precisions twice too large: variances four times too small."""
    for cameras in (1, 4):
        gaussian = value(overconfident, "normalised_squared_error", "gaussian", cameras)
        assert gaussian == pytest.approx(4, abs=4 * SPREAD)
    # linear tails give less weight to contradictions: ours is less overconfident than the Gaussian
    assert 1.5 < value(overconfident, "normalised_squared_error", "mean", 4) < 3.5
    assert value(overconfident, "coverage_90", "mean", 4) > value(overconfident, "coverage_90", "gaussian", 4)
    assert overconfident.surprise[-1] > 3 * np.mean(overconfident.surprise[:-1])


def test_every_further_camera_helps_and_weights_help_more_than_an_average(scores: FusionScores) -> None:
    for quantity in ("depth_error_mm", "distance_mm"):
        for method in METHODS:
            errors = [value(scores, quantity, method, k) for k in (1, 2, 3, 4)]
            assert errors == sorted(errors, reverse=True), method
            assert value(scores, quantity, method, 1, on_plane=True) < errors[0]
        for k in (2, 3, 4):
            assert value(scores, quantity, "mode", k) < 0.6 * value(scores, quantity, "average", k)


def test_with_one_camera_every_method_returns_its_own_estimate(calibrated: Path, scores: FusionScores) -> None:
    views = read_views(calibrated)
    table = pd.read_parquet(calibrated)
    first = table[table["view"] == 0]
    for method in ("mode", "average"):
        expected = first["depth_error_mm"].mean()
        assert value(scores, "depth_error_mm", method, 1) == pytest.approx(expected, rel=1e-6)
    off = first[["mean_x", "mean_y", "mean_z"]].to_numpy() - first[["x", "y", "z"]].to_numpy()
    expected = 1000 * np.linalg.norm(off, axis=1).mean()
    assert value(scores, "distance_mm", "gaussian", 1) == pytest.approx(expected, rel=1e-6)
    assert value(scores, "distance_mm", "mean", 1) == pytest.approx(expected, rel=1e-4)
    assert (scores.n, scores.views, scores.left_out) == (N, 4, 0)
    assert (views.n, views.views) == (N, 4)


def test_all_views_and_the_ground_agree_on_the_truth(calibrated: Path) -> None:
    views = read_views(calibrated)
    world = views.pose.into_world(views.xyz)
    torch.testing.assert_close(world, views.truth[:, None].expand_as(world))
    ground = views.ground
    torch.testing.assert_close(ground.nearest(views.truth), views.truth)
    gravity = views.first.R @ ground.normal[..., None]
    torch.testing.assert_close(gravity[0, :, 0], torch.tensor([0, np.sqrt(3) / 2, 0.5], dtype=torch.float64))


def test_two_cameras_by_hand(calibrated: Path, scores: FusionScores) -> None:
    """Precisions add in the world: (sum C_i^-1)^-1 sum C_i^-1 m_i, with C = R^T C' R."""
    two = read_views(calibrated).cameras(2)
    precision = torch.linalg.inv(two.pose.R.mT @ two.predictions.covariance_matrix @ two.pose.R)
    weighted = (precision @ two.pose.into_world(two.predictions.mean)[..., None]).sum(1)
    mean = torch.linalg.solve(precision.sum(1), weighted).squeeze(-1)
    modes = two.pose.into_world(two.predictions.mode).mean(1)
    for method, position in (("gaussian", mean), ("average", modes)):
        expected = 1000 * (position - two.truth).norm(dim=-1).mean()
        assert value(scores, "distance_mm", method, 2) == pytest.approx(float(expected))


def test_conditioning_is_the_limit_of_a_narrow_observation() -> None:
    random = torch.Generator().manual_seed(0)
    factor, mean, normal = (torch.randn(*s, generator=random).double() for s in ((8, 3, 3), (8, 3), (8, 3)))
    covariance = factor @ factor.mT + 0.1 * torch.eye(3).double()
    plane = Plane(normal, torch.linspace(-1, 1, 8).double())
    point, left = conditioned(mean, covariance, plane)
    narrow = 1e-8  # its own error is of this size, that of rounding about 1e-15 / narrow
    precision = torch.linalg.inv(covariance) + normal[:, :, None] * normal[:, None] / narrow
    expected = torch.linalg.inv(precision)
    shift = torch.linalg.inv(covariance) @ mean[..., None] + (normal * plane.offset[:, None])[..., None] / narrow
    torch.testing.assert_close(left, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(point, (expected @ shift).squeeze(-1), atol=1e-5, rtol=0)
    torch.testing.assert_close(plane.nearest(point), point)


def test_errors_that_views_share_are_detected(folder: Path, scores: FusionScores) -> None:
    file = folder / "common.parquet"
    write_views(file, N, a=30.0, common=0.1)
    found = fusion_scores(read_views(file), resamples=50)
    table = pd.read_parquet(file)
    errors = np.log(table["mu_z"] / table["z"]).to_numpy().reshape(N, 4)
    F = stats.f_oneway(*errors).statistic
    assert found.correlation.value == pytest.approx((F - 1) / (F + 3), abs=4 / N)
    assert found.correlation.low < found.correlation.value < found.correlation.high
    assert found.correlation.value > 0.4
    # depths carry little weight from cameras far apart, even where they are overconfident
    for quantity in ("distance_mm", "normalised_squared_error"):
        assert value(found, quantity, "shared", 4) < 1.2 * value(found, quantity, "mean", 4), quantity
    size = np.log(table["scale"].to_numpy().reshape(N, 4)[:, 0])
    assert found.with_size.value == pytest.approx(np.corrcoef(errors.mean(1), size)[0, 1])
    assert found.with_size.value < -0.8
    # no common cause, no correlation; equal sizes have none with anything
    assert scores.correlation.low < 0.08
    assert np.isnan(scores.with_size.value)
    # correlated views gain less from averaging
    assert value(found, "depth_error_mm", "average", 4) > 1.5 * value(scores, "depth_error_mm", "average", 4)


def changed(file: Path, to: Path, change: "object") -> Path:
    table = pd.read_parquet(file).head(80)
    change(table).to_parquet(to)
    return to


def test_a_scene_with_a_prediction_that_is_not_finite_is_left_out(calibrated: Path, folder: Path) -> None:
    whole = fusion_scores(
        read_views(changed(calibrated, folder / "whole", lambda t: t[4:].assign(scene=t["scene"] - 1))), 10
    )
    holed = changed(calibrated, folder / "holed", lambda t: t.assign(a=t["a"].where(t.index != 2)))
    found = fusion_scores(read_views(holed), 10)
    assert (found.n, found.left_out, whole.n, whole.left_out) == (19, 1, 19, 0)
    for place, band in whole.bands.items():
        assert found.bands[place].value == pytest.approx(band.value, rel=1e-9)


ORDER = "not every view of every scene, two or more, in order"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.drop(columns="pose_w"), "no column pose_w"),
        (lambda t: t[1:], ORDER),
        (lambda t: t[::-1], ORDER),
        (lambda t: t[t["view"] == 0], ORDER),
        (lambda t: t[:0], "has no rows"),
        (lambda t: t.assign(a=np.nan), "of no scene all predictions are finite"),
        (lambda t: t.assign(a=-1.0), "no predictions with poses"),
        (lambda t: t.assign(pose_w=2.0), "no predictions with poses"),
    ],
)
def test_a_bad_record_is_one_line(calibrated: Path, tmp_path: Path, change: "object", message: str) -> None:
    with pytest.raises(RunError, match=f"^{tmp_path / 'changed'}: {message}") as caught:
        read_views(changed(calibrated, tmp_path / "changed", change))
    assert "\n" not in str(caught.value)
