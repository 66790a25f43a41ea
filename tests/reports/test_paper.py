"""What the paper prints, and the floors recomputed."""

import math

import pytest
from scipy.integrate import dblquad

from phd_exp.reports import paper
from phd_exp.reports.paper import LAYOUTS, PUBLISHED, floor_mm, published_mm


def floor_of_a_ratio(low: float, high: float) -> float:
    """Least expected |z - z^|, mm, for z ~ U(3, 5) of which r = s / z alone is seen, s ~ U(low, high).

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


def test_the_floor_where_size_is_unknown() -> None:
    assert pytest.approx(floor_of_a_ratio(0.8, 1.2), abs=0.5) == paper.FLOOR_OF_SCALE


def test_the_floor_where_focal_length_is_unknown() -> None:
    assert pytest.approx(floor_of_a_ratio(1200, 2000), abs=0.5) == paper.FLOOR_WITHOUT_F


def test_the_floor_of_knowing_nothing() -> None:
    # z ~ U(3, 5): the mean distance to its median 4 is a quarter of its range
    assert paper.FLOOR_OF_NOTHING == 1000 * (5 - 3) / 4


def test_floors_bind_those_alone_that_know_no_more() -> None:
    bound = {
        (model, data): floor_mm(model, data, "depth")
        for model in ("mae_vz", "probabilistic", "mae_xyz", "mae_constf")
        for data in ("default", "occl", "scale", "occl_scale")
    }
    assert {key: value for key, value in bound.items() if value} == {
        ("mae_vz", "scale"): 291,
        ("mae_vz", "occl_scale"): 291,
        ("probabilistic", "scale"): 291,
        ("probabilistic", "occl_scale"): 291,
        ("mae_xyz", "default"): 331,
        ("mae_constf", "default"): 331,
    }
    assert floor_mm("probabilistic", "scale", "projected") is None


def test_every_published_figure_has_its_place() -> None:
    places = {(model, data) for layout in LAYOUTS for data, model in layout.choices}
    assert places == PUBLISHED.keys()


def test_the_paper_publishes_modes_alone() -> None:
    assert published_mm("probabilistic", "occl", "mode", "projected") == 13.0
    assert published_mm("probabilistic", "occl", "mode", "depth") == 168
    assert published_mm("probabilistic", "occl", "median", "depth") is None
    assert published_mm("probabilistic", "photos", "mode", "depth") is None
