"""Every finished run as lines of CSV: each mean error with its interval, and how the run was made."""

import shlex
from collections.abc import Iterator
from typing import Any

from phd_exp.records.choices import PLAIN_RECIPE, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.reports.cells import interval
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import bounds


def run_lines(report: Report) -> list[dict[str, Any]]:
    """A line for every error of every finished run, and one for its NLL, whose interval is not computed."""
    return [
        run.choice
        | {"seed": run.seed, "overrides": run.digest}
        | number
        | {"command": command_of(run), "git_commit": run.status.git_commit, "machine": run.status.machine}
        for run in report.runs
        if run.state == "finished" and run.status
        for number in _numbers(run)
    ]


def _numbers(run: Run) -> Iterator[dict[str, Any]]:
    for key, mean in run.errors.items():
        name = {"estimate": key.estimate, "reading": key.reading, "quantity": f"{key.quantity}_error_mm"}
        yield name | {"mean": mean.value, **bounds(interval([mean])), "n_test": mean.n}
    if run.nll is not None:
        n = max(mean.n for mean in run.errors.values())
        name = {"estimate": "", "reading": "whole", "quantity": "nll"}
        yield name | {"mean": run.nll, **bounds(None), "n_test": n}


def command_of(run: Run) -> str:
    """The command line that makes a run."""
    preset, recipe = preset_and_recipe(run.preset)
    words = [f"preset={preset}", f"data={run.data}", f"model={run.model}", f"seed={run.seed}"]
    words += [f"recipe={recipe}"] if recipe != PLAIN_RECIPE else []
    words += run.status.overrides if run.status else []
    return one_line(shlex.join(["python", "-m", "phd_exp", *words]))
