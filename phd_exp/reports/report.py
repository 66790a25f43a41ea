"""All runs and searches under a folder, each read inside its own boundary, and their numbers as tables of pandas."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd

from phd_exp.records.files import make_folder
from phd_exp.records.runs import find_runs
from phd_exp.records.searches import Search, read_searches
from phd_exp.reports.ensembles import ensemble_scores
from phd_exp.reports.measured import Notes
from phd_exp.reports.numbers import (
    AS_TRAINED,
    FACTS,
    as_long,
    differences,
    facts_of,
    lines_of,
    numbers_of,
    over_seeds,
    trials_of,
)
from phd_exp.reports.paper import published
from phd_exp.reports.runs import PROBABILISTIC, Run, read_run, unreadable
from phd_exp.reports.table import printable


@dataclass(frozen=True)
class Report:
    """All runs and searches under a folder, sorted: read once for the terminal, the files and the pages.

    `notes` are the problems of tables, figures and searches, which belong to no page; `kept` stores measurements.
    """

    folder: Path
    runs: tuple[Run, ...]
    searches: tuple[Search, ...] = ()
    notes: Notes = field(default_factory=Notes)
    kept: Path | None = None

    @cached_property
    def numbers(self) -> pd.DataFrame:
        """The numbers of single runs and trials; columns as of `numbers.COLUMNS`."""
        return numbers_of(self.runs, self.searches)

    @cached_property
    def facts(self) -> pd.DataFrame:
        """A row for each run, with the columns `FACTS`."""
        return pd.DataFrame([facts_of(run) for run in self.runs], columns=list(FACTS)).astype({"seed": "Int64"})

    @cached_property
    def presets(self) -> list[str]:
        """All presets, with their recipes, sorted."""
        return sorted({run.preset for run in self.runs})

    def select(self, **choice: Any) -> pd.DataFrame:
        """The numbers whose columns have a value, or one of a list, with the facts of their runs."""
        found = self.numbers
        for column, values in choice.items():
            found = found[found[column].isin([values] if isinstance(values, str) else values)]
        return found.rename(columns={"run": "path"}).merge(self.facts, on="path", how="inner")

    @cached_property
    def of_seeds(self) -> pd.DataFrame:
        """The numbers of finished runs that are averaged or compared over seeds."""
        found = self.select(subject=["whole", "central", "2 cameras"], split=["test", "held-out", "views"])
        return found[(found["state"] == "finished") & found["seed"].notna()]

    @cached_property
    def densities(self) -> pd.DataFrame:
        """Scores of the runs of densities, on test images and on pairs of cameras."""
        found = self.of_seeds[(self.of_seeds["method"] == AS_TRAINED) & (self.of_seeds["subject"] != "central")]
        return found[found["path"].isin(found["path"][found["quantity"] == "nll"])]

    @cached_property
    def held_out(self) -> pd.DataFrame:
        """Scores on images held out of training."""
        return self.of_seeds[(self.of_seeds["split"] == "held-out") & (self.of_seeds["subject"] == "whole")]

    @cached_property
    def gaps(self) -> dict[str, pd.DataFrame]:
        """By the name of the other: paired differences to the probabilistic model, and to runs without overrides."""
        return {
            PROBABILISTIC: differences(self.densities, "model", PROBABILISTIC),
            "": differences(self.held_out, "words", ""),
        }

    @cached_property
    def ensembles(self) -> pd.DataFrame:
        """The scores of ensembles, as of `ensemble_scores`."""
        return ensemble_scores(self.runs, self.notes, self.kept)

    @cached_property
    def means(self) -> pd.DataFrame:
        """Their means over seeds, as of `over_seeds`."""
        return over_seeds(self.of_seeds)

    @property
    def long(self) -> pd.DataFrame:
        """Every number of the report, one row each, with the columns `numbers.COLUMNS`."""
        gaps = [as_long(gaps, f", minus {name or 'no overrides'}") for name, gaps in self.gaps.items()]
        return pd.concat([self.numbers, as_long(self.means), as_long(self.ensembles), *gaps, published()])


def read_report(runs: Path, kept: Path | None = None, progress: Callable[[str], None] = lambda run: None) -> Report:
    """Read and measure every run; the folder `kept`, if given, stores measurements until their run changes.

    A run or search that cannot be shown is left out of all tables. Raises OSError if that folder cannot be written.
    """
    found, folders, notes = [], find_runs(runs), Notes()
    if folders and kept:
        make_folder(kept)
    for folder in folders:
        progress("/".join(map(printable, folder.names)))
        found.append(_whole(read_run(folder, kept)))
    searches = [
        one for one in read_searches(runs) if notes.attempt(partial(trials_of, one), _left_out(one)) is not None
    ]
    return Report(runs, tuple(found), tuple(searches), notes, kept)


def _left_out(search: Search) -> str:
    return f"search {search.name} is left out: "


def _whole(run: Run) -> Run:
    """The run, or one of which only the place is shown if its numbers or facts raise an error."""
    notes = Notes()
    whole = notes.attempt(lambda: (list(lines_of(run)), facts_of(run)))
    return run if whole else unreadable(run.folder, notes)


def measured(runs: Path, kept: Path) -> pd.DataFrame:
    """The long table of all runs under a folder; uses measurements that `report` has stored in the folder `kept`."""
    return read_report(runs, kept if kept.is_dir() else None).long.reset_index(drop=True)
