"""How good the predictions of a run are, before and after recalibration: where pages meet the evaluation."""

from dataclasses import dataclass

import pyarrow as pa

from phd_exp.distributions.temperature import Temperature
from phd_exp.evaluation.predictions import (
    Evaluation,
    evaluate,
    evaluate_points,
    held_out_temperature,
    recalibrated,
)
from phd_exp.records.runs import RunFolder


@dataclass(frozen=True)
class Assessment:
    """Of a baseline, errors alone; of a distribution, everything, and again after recalibration.

    Attributes:
        before: of the predictions as recorded.
        after: of the same predictions recalibrated; None where nothing was held out.
        temperature: what recalibrated them, fitted on samples held out of training.
    """

    before: Evaluation
    after: Evaluation | None = None
    temperature: Temperature | None = None


def is_distribution(predictions: pa.Table) -> bool:
    """Whether predictions are densities, not points alone."""
    return "a" in predictions.column_names


def assess(folder: RunFolder, predictions: pa.Table) -> Assessment:
    """Evaluate the predictions of a run. Raises RunError where a table lacks what is needed."""
    if not is_distribution(predictions):
        return Assessment(evaluate_points(predictions))
    before = evaluate(predictions)
    if not folder.held_out.exists():
        return Assessment(before)
    temperature = held_out_temperature(folder)
    return Assessment(before, evaluate(recalibrated(predictions, temperature)), temperature)
