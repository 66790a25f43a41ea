"""HTML of the pages; whatever comes from files is escaped."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phd_exp.evaluation.reference import Band
from phd_exp.records.processes import duration
from phd_exp.reports.fusion_table import fusion_table, headline
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.quantities import SCORES, Quantity, quantity
from phd_exp.reports.runs import Run
from phd_exp.reports.site.overview import Drawn, Group
from phd_exp.reports.table import Table

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class ScoreRow:
    """One line of a run's table of numbers."""

    key: str
    quantity: Quantity
    before: Band
    after: Band | None
    reference: Band | None
    paper: float | None


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["moment"] = _moment
    environment.filters["duration"] = duration
    environment.globals["score"] = quantity
    environment.globals["headline"] = headline
    return environment


def _moment(moment: datetime) -> str:
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC"


_ENVIRONMENT = _environment()


def overview_page(
    runs: Sequence[Run], tables: Sequence[Table], groups: Mapping[str, Group], figures: Sequence[str]
) -> str:
    """`index.html`: the list of runs, the tables, the charts of all runs."""
    kinds: dict[str, list[Table]] = {}
    for table in tables:
        kinds.setdefault(table.kind, []).append(table)
    paper = kinds.get("tables", [])
    presets = sorted({table.preset for table in paper}, key=lambda name: -_runs_of(runs, name))
    return _ENVIRONMENT.get_template("overview.html").render(
        root="",
        several=len(runs) > 1,
        runs=runs,
        papers=[[table for table in paper if table.preset == preset] for preset in presets],
        kinds=kinds,
        groups=groups,
        figures=figures,
        overrides=any(run.overrides for run in runs),
        finished=sum(run.state == "finished" for run in runs),
        choices={"preset": sorted({run.preset for run in runs}), "data": sorted({run.data for run in runs})},
    )


def _runs_of(runs: Sequence[Run], preset: str) -> int:
    return sum(run.preset == preset and run.state == "finished" for run in runs)


def run_page(drawn: Drawn, several: bool) -> str:
    """The page of one run."""
    run = drawn.run
    return _ENVIRONMENT.get_template("run.html").render(
        root="../",
        several=several,
        run=run,
        measured=run.measured,
        scores=_score_rows(run),
        environment=_ran_on(run),
        charts=drawn.charts,
        fusion=fusion_table(run, run.measured.fusion) if run.measured.fusion else None,
    )


def _ran_on(run: Run) -> dict[str, str]:
    """Machine, commit, data set and versions."""
    status = run.status
    if status is None:
        return {}
    known = {"machine": status.machine, "git commit": status.git_commit, "data set": status.data_manifest}
    return {name: value or "unknown" for name, value in known.items()} | status.versions


def comparison_page(runs: Sequence[Run]) -> str:
    """`compare.html`: any two runs side by side."""
    quantities = {key: asdict(score) for key, score in SCORES.items()}
    template = _ENVIRONMENT.get_template("compare.html")
    return template.render(root="", several=True, runs=runs, quantities=quantities)


def _score_rows(run: Run) -> list[ScoreRow]:
    """In the order of `SCORES`."""
    before, after = run.measured.before, run.measured.after
    if before is None:
        return []
    published = PUBLISHED.get((run.model, run.data))
    names = [name for name in SCORES if name in before.scores]
    return [
        ScoreRow(
            name,
            SCORES[name],
            before.scores[name],
            after.scores.get(name) if after else None,
            before.reference.get(name),
            getattr(published, name, None),
        )
        for name in names
    ]


def run_script(drawn: Drawn) -> str:
    """What the charts of a run and the comparison show."""
    run, before = drawn.run, drawn.run.measured.before
    content = {
        "preset": run.preset, "data": run.data, "model": run.model, "run": run.name, "title": run.title,
        "images": run.measured.images, "config": dict(run.config),
        "scores": {row.key: asdict(row.before) for row in _score_rows(run)},
        "resampled": _short(before.resampled) if before else {},
        "charts": {key: asdict(chart) for charts in drawn.charts.values() for key, chart in charts.items()},
    }  # fmt: skip
    return as_script(run.slug, content)


def _short(resampled: Mapping[str, Sequence[float]]) -> dict[str, list[float]]:
    return {name: [float(f"{value:.6g}") for value in values] for name, values in resampled.items()}


def as_script(name: str, content: Any) -> str:
    """`phdExp.receive("<name>", {...});`, a script because pages opened as files may not fetch.

    Safe in HTML and JavaScript: without <, >, & and line separators. NaN and infinity become null.
    """
    finite = json.loads(json.dumps(content), parse_constant=lambda _: None)
    text = f"phdExp.receive({json.dumps(name)}, {json.dumps(finite, separators=(',', ':'))});\n"
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text
