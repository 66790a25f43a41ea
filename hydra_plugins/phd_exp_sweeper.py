"""The sweeper of phd_exp, where Hydra finds plugins. Other programmes that use Hydra load this file too."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class EveryCombination(Sweeper):
    """Runs every combination of the values on the command line and in an experiment: `phd_exp.cli.sweep`."""

    def __init__(self, params: Mapping[str, Any] | None = None, each: Sequence[Sequence[str]] | None = None) -> None:
        self.params, self.each = params, each  # from conf/experiment; `sweep` reads them for each experiment

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        from phd_exp.cli.jobs import Job
        from phd_exp.cli.sweep import sweep

        assert isinstance(task_function, Job)
        self.run = partial(sweep, task_function, config, hydra_context)

    def sweep(self, arguments: list[str]) -> list[float | None]:
        """Run all jobs; returns their scores."""
        return self.run(arguments)
