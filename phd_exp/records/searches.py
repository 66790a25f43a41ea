"""The record of a search: every trial with its values, readable without Optuna.

runs/.search/NAME/
    study.db       Optuna's study, from which the search resumes
    search.json    its trials and the importance of each key, rewritten after every trial
"""

from pathlib import Path
from typing import Literal

from pydantic import FiniteFloat, ValidationError

from phd_exp.records.errors import gist
from phd_exp.records.files import read_plain
from phd_exp.records.parsing import Record
from phd_exp.records.processes import announce

SEARCHES, RECORD = ".search", "search.json"
TrialState = Literal["finished", "pruned", "failed", "running"]


class Trial(Record):
    """One trial: its overrides, the folder of its run, and the held-out score; of a pruned one, the last score."""

    number: int
    state: TrialState
    overrides: dict[str, str]
    run: str
    value: FiniteFloat | None = None


class Search(Record):
    """All trials of a search.

    Attributes:
        objective: the metric that is minimised.
        importances: share of each key in the variance of the objective, as Optuna estimates it.
    """

    name: str
    objective: str
    trials: list[Trial]
    importances: dict[str, FiniteFloat]

    @property
    def finished(self) -> list[tuple[float, Trial]]:
        """The values of the finished trials, and these trials, in the order of their numbers."""
        return [(one.value, one) for one in self.trials if one.state == "finished" and one.value is not None]

    @property
    def best(self) -> Trial | None:
        """The finished trial with the smallest value."""
        return min(self.finished, key=lambda found: found[0], default=(0.0, None))[1]


def read_searches(runs: Path) -> list[Search]:
    """All searches below a folder of runs; a line on standard error names a record that cannot be read."""
    found = []
    for file in sorted(runs.glob(f"{SEARCHES}/*/{RECORD}")):
        try:
            found.append(Search.model_validate_json(read_plain(file)))
        except (OSError, ValidationError) as error:
            announce(f"note: {file}: not the record of a search ({gist(error)})")
    return found
