"""The factor of the learning rate over the steps."""

import pytest

from phd_exp.training.module import factor


def test_constant_is_one_throughout() -> None:
    assert {factor("constant", 0, 100)(step) for step in range(100)} == {1.0}


def test_it_rises_evenly_and_falls_as_half_a_wave() -> None:
    at = factor("cosine", 9, 1000)
    assert at(0) == pytest.approx(0.1, rel=1e-4)
    assert at(4) == pytest.approx(0.5, rel=1e-3)
    assert at(9) == pytest.approx(1, rel=1e-3)
    assert at(500) == pytest.approx(0.5)
    assert at(1000) == pytest.approx(0, abs=1e-12)
    assert at(1001) == at(1000)  # a step is asked for beyond the last
    falling = [at(step) for step in range(10, 1000)]
    assert falling == sorted(falling, reverse=True)
