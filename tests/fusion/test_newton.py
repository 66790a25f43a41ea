"""The smooth stand-in for max(t, 1/t), and the compiled code that is kept on disk."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from phd_exp.fusion import kernels
from phd_exp.fusion.__main__ import main
from phd_exp.fusion.newton import extended_inverse, smooth_depth_energy

LEAST = 1e-2


def stand_in(t: np.ndarray, width: float, least: float = LEAST) -> np.ndarray:
    return np.array([smooth_depth_energy(x, extended_inverse(x, least)[0], width)[0] for x in t])


@pytest.mark.parametrize("width", [1e-3, 1.0])
def test_the_stand_in_is_convex_also_across_zero(width: float) -> None:
    """Along random chords."""
    random = np.random.default_rng(0)
    (one, other), share = random.uniform(-0.5, 2.5, (2, 2000)), random.uniform(size=2000)
    chord = (1 - share) * stand_in(one, width) + share * stand_in(other, width)
    assert (stand_in((1 - share) * one + share * other, width) <= chord * (1 + 1e-12)).all()


@pytest.mark.parametrize("width", [0.0, 1e-6, 1e-2, 1.0])
def test_the_stand_in_is_too_large_by_its_width_at_most(width: float) -> None:
    t = np.linspace(LEAST, 3, 999)
    excess = stand_in(t, width) - np.maximum(t, 1 / t)
    assert (excess >= -1e-12 / t).all()
    assert (excess <= width + 1e-12 / t).all()


def test_the_continued_inverse_has_its_own_derivatives() -> None:
    t, step, least = np.linspace(-1, 2, 61), 1e-6, 0.3
    value, first, second = np.array([extended_inverse(x, least) for x in t]).T
    after, before = (np.array([extended_inverse(x + s, least) for x in t]).T for s in (step, -step))
    np.testing.assert_allclose(first, (after[0] - before[0]) / (2 * step), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(second, (after[1] - before[1]) / (2 * step), rtol=1e-4)
    np.testing.assert_allclose(value[t >= least], 1 / t[t >= least])


def test_everything_is_compiled_ahead_on_request() -> None:
    main()
    assert kernels.solve.signatures
    assert kernels.all_moments.signatures


MODULE = """
from numba import njit

def function(sources):
    @njit(cache=True)
    def following(x):
        assert len(sources) > 0
        return x + 1
    return following
"""


def test_numba_compiles_anew_what_closes_over_another_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On this rests that no change of the sources leaves old compiled code in use."""
    (tmp_path / "module_of_numba.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("module_of_numba")
    for sources, hits in (("one", 0), ("one", 1), ("other", 0), ("other", 1)):
        following = module.function(sources)
        assert following(1) == 2
        assert sum(following.stats.cache_hits.values()) == hits
