"""What Hydra's other sweepers receive from a job: never a number of test samples."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hydra.experimental.callback import Callback

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.runs import CHOOSE, RunFolder


class Received(Callback):
    """Keeps what a job returns to the sweeper, by its overrides."""

    scores: ClassVar[dict[tuple[str, str], float | None]] = {}

    def on_job_end(self, config: Any, job_return: Any, **rest: Any) -> None:
        self.scores[config.model.name, str(config.data.n_held_out)] = job_return.return_value


def test_the_score_is_that_of_the_held_out_samples_that_may_choose(own: Callable) -> None:
    axes = ("model=probabilistic,mae_vz", "data.n_held_out=7,0")
    callback = f"+hydra.callbacks.received._target_={__name__}.Received"
    outcome = own("-m", "hydra/sweeper=basic", callback, *axes, "trainer.max_epochs=1")
    assert outcome.status == 0, outcome.err
    for path in Path("runs").glob("*/*/*/seed*"):
        run = RunFolder(path)
        config = run.config()
        model, n = config["model"]["name"], config["data"]["n_held_out"]
        score = Received.scores.pop((model, str(n)))
        if n:
            table = read_table(run.held_out)
            name = "nll" if model == "probabilistic" else "depth_error_mm"
            assert len(table[name]) == n
            assert score == pytest.approx(math.fsum(table[name][CHOOSE]) / len(table[name][CHOOSE]))
        else:
            assert score is None
    assert not Received.scores, "a run for each job"
    lines = [line for line in outcome.out.splitlines() if "no score" in line]
    assert len(lines) == 2
    assert all("data.n_held_out" in line for line in lines)
