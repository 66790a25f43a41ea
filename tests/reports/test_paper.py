"""What the paper prints, and the bounds recomputed."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.integrate import dblquad

from phd_exp.reports import paper
from phd_exp.reports.paper import LAYOUTS, PUBLISHED, bound_mm


def bound_of_a_ratio(low: float, high: float) -> float:
    """Least expected |z - z^|, mm, for z ~ U(3, 5) if r = s / z alone is observed, s ~ U(low, high).

    Given r, z has a density proportional to z between max(3, low / r) and min(5, high / r): its median is the root
    mean square of these bounds. The joint density of (z, r) is z / (2 (high - low)).
    """

    def integrand(z: float, r: float) -> float:
        least, most = max(3.0, low / r), min(5.0, high / r)
        return abs(z - math.sqrt((least**2 + most**2) / 2)) * z / (2 * (high - low))

    value, _ = dblquad(
        integrand, low / 5, high / 3, lambda r: max(3.0, low / r), lambda r: min(5.0, high / r), epsabs=1e-5
    )
    return 1000 * value


def test_bounds_equal_an_integral() -> None:
    assert pytest.approx(bound_of_a_ratio(0.8, 1.2), abs=0.5) == paper.UNKNOWN_SIZE
    assert pytest.approx(bound_of_a_ratio(1200, 2000), abs=0.5) == paper.UNKNOWN_F
    assert paper.GUESS == 1000 * (5 - 3) / 4  # the mean distance of U(3, 5) from its median is a quarter of its range


def test_the_bound_where_size_and_focal_length_are_unknown() -> None:
    """The network estimates z / f from the apparent size s f / z; the true f multiplies its answer. By simulation."""
    random = np.random.default_rng(0)
    z, s, f = (random.uniform(low, high, 1_000_000) for low, high in ((3, 5), (0.8, 1.2), (1200, 2000)))
    parts = np.array_split(np.argsort(s * f / z), 300)  # in each the network sees one size
    absolute = [f[part] * np.abs(z[part] / f[part] - _weighted_median(z[part] / f[part], f[part])) for part in parts]
    errors = np.concatenate(absolute)
    assert 1000 * errors.mean() == pytest.approx(paper.UNKNOWN_SIZE_F_AFTERWARDS, abs=2)
    without_f = np.concatenate([np.abs(z[part] - np.median(z[part])) for part in parts])
    assert 1000 * without_f.mean() == pytest.approx(paper.UNKNOWN_SIZE_AND_F, abs=2)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = weights[order].cumsum()
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def test_bounds_apply_only_to_models_with_as_little_information() -> None:
    models, sets = ("mae_vz", "probabilistic", "mae_xyz"), ("default", "occl", "scale", "occl_scale")
    for model, data, sees_f in product(models, sets, (False, True)):
        on_scale = 370 if model == "mae_xyz" else 291 if sees_f else 336
        expected = {"scale": on_scale, "default": 331 if model == "mae_xyz" else None}.get(data)
        assert bound_mm(model, data, "depth", sees_f) == expected
        assert bound_mm(model, data, "projected", sees_f) is None


def test_every_published_figure_has_its_place() -> None:
    places = {(model, data) for layout in LAYOUTS for data, model in product(layout.data, layout.models)}
    assert places == PUBLISHED.keys()
