"""Edges are averages over Blender's own pixel filter."""

import numpy as np
import pytest

from phd_exp.records.scenes import Scene
from phd_exp.rendering.antialias import FILTER_WIDTH, REACH, edges, filter_points, smoothed
from phd_exp.rendering.rays import NOTHING, trace_pixels
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import MakeSpec


@pytest.fixture(scope="module")
def scene(make_spec: MakeSpec) -> Scene:
    """Three objects, one of which hides another."""
    return sample_scene(make_spec("occl_scale", sensor_size=96, f_range=(514.0, 857.0)), "train", 2)


def window(offset: np.ndarray) -> np.ndarray:
    angle = 2 * np.pi * (offset / FILTER_WIDTH + 0.5)
    return 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)


def test_points_have_the_moments_of_the_filter() -> None:
    fine = np.linspace(-FILTER_WIDTH / 2, FILTER_WIDTH / 2, 10_001)
    variance = (window(fine) * fine**2).sum() / window(fine).sum()
    for offsets in filter_points():
        assert np.abs(offsets).max() < FILTER_WIDTH / 2 < REACH
        assert offsets.mean() == pytest.approx(0, abs=1e-12)
        assert offsets.var() == pytest.approx(variance, rel=0.1)
    assert np.corrcoef(*filter_points())[0, 1] == pytest.approx(0, abs=1e-9)


def test_away_from_edges_nothing_changes(scene: Scene) -> None:
    light = np.random.default_rng(0).random((scene.S, scene.S, 3))
    surfaces = trace_pixels(scene).first
    away = ~edges(surfaces, REACH)
    assert (smoothed(light, surfaces, scene)[away] == light[away]).all()


def test_an_edge_is_the_filters_mean_over_a_much_finer_image(scene: Scene) -> None:
    """Each surface of one light: the share of every surface in a pixel, against 15 x 15 rays a pixel."""
    surfaces = trace_pixels(scene).first
    value = np.random.default_rng(1).random(64)
    result = smoothed(np.repeat(value[surfaces][..., None], 3, axis=-1), surfaces, scene)[..., 0]

    times = 15
    fine = trace_pixels(scene.model_copy(update={"S": times * scene.S, "f": times * scene.f})).first
    offsets = (np.arange(3 * times) + 0.5) / times - 1.5
    weight = window(offsets) / window(offsets).sum()
    padded = np.pad(value[fine], times, mode="edge")
    across = np.stack([padded[:, c * times : (c + 3) * times] @ weight for c in range(scene.S)], axis=1)
    mean = np.stack([weight @ across[r * times : (r + 3) * times] for r in range(scene.S)])
    inner = slice(REACH, -REACH)  # beyond the border the finer image knows nothing
    difference = (result - mean)[inner, inner]
    assert len(np.unique(surfaces)) >= 5
    assert np.abs(difference).max() < 0.15
    assert np.sqrt((difference[edges(surfaces, 1)[inner, inner]] ** 2).mean()) < 0.025
    assert difference.mean() == pytest.approx(0, abs=1e-3)


def test_a_surface_too_thin_for_any_pixel_does_no_harm(scene: Scene) -> None:
    thin = scene.objects[0].model_copy(update={"dimensions": (0.0004, 0.0004, 0.5)})
    bare = scene.model_copy(update={"objects": (thin,)})
    surfaces = trace_pixels(bare).first
    light = np.full((scene.S, scene.S, 3), 0.5)
    light[surfaces != NOTHING] = 1.0
    result = smoothed(light, surfaces, bare)
    assert np.isfinite(result).all()
    assert 0.5 <= result.min() <= result.max() <= 1.0
