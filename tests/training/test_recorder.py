"""When calibration curves are recorded."""

from collections.abc import Callable
from fractions import Fraction

import pytest

from phd_exp.config import check
from phd_exp.config.sections import EvaluationConfig
from phd_exp.training.recorder import has_curves


@pytest.mark.parametrize("wanted", [1, 2, 7, 10])
@pytest.mark.parametrize("every", [1, 2, 3, 4, 5, 10, 22])
def test_curves_are_those_of_the_evaluations_nearest_to_the_wanted_epochs(wanted: int, every: int) -> None:
    evaluation = EvaluationConfig(calibration_window=200, calibration_every_n_epochs=wanted, every_n_epochs=every)
    evaluated = range(every, 400, every)
    nearest = {
        min(evaluated, key=lambda epochs: (abs(epochs - at), epochs))
        for at in range(wanted, 300, wanted)
        if Fraction(at, every) > Fraction(1, 2)  # else nearer to the untrained network
    }
    found = {epochs for epochs in evaluated if has_curves(epochs, evaluation)}
    assert {epochs for epochs in found if epochs < 250} == {epochs for epochs in nearest if epochs < 250}
    if wanted % every == 0:
        assert found == {epochs for epochs in evaluated if epochs % wanted == 0}


def test_the_interval_of_evaluations_is_free(composed: Callable) -> None:
    assert check(composed("preset=smoke", "evaluation.every_n_epochs=22")).evaluation.every_n_epochs == 22
