"""HTML of the pages; all text from files is escaped."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phd_exp.evaluation.fusion import FusionScores
from phd_exp.evaluation.tracks import TrackScores
from phd_exp.records.processes import duration
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.quantities import SCORES, mark
from phd_exp.reports.runs import Run
from phd_exp.reports.scene import scene_traces
from phd_exp.reports.site.overview import Drawn, Groups, presets_of
from phd_exp.reports.table import Table, file_stem

_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {
    "moment": lambda at: f"{at:%Y-%m-%d %H:%M} {at.tzname()}",
    "duration": duration,
    "metres": lambda xyz: f"({', '.join(f'{one:.4g}' for one in xyz)}) m",
}
_ENVIRONMENT.globals |= {"score": SCORES.__getitem__, "mark": mark}
HEADLINES = ("projected_error_mm", "depth_error_mm", "inside_90", "nll")


def overview_page(runs: Sequence[Run], tables: Sequence[Table], groups: Groups, figures: Sequence[str]) -> str:
    """`index.html`: the list of runs, the tables, the charts of all runs."""
    kinds: dict[str, list[Table]] = {}
    for table in tables:
        kinds.setdefault(table.kind, []).append(table)
    return _ENVIRONMENT.get_template("overview.html").render(
        root="",
        several=len(runs) > 1,
        runs=runs,
        kinds=kinds,
        presets=presets_of(runs),
        groups=groups,
        headlines={"fusion": _of_fusion, "tracks": _of_tracks},
        figures=figures,
        finished=sum(run.state == "finished" for run in runs),
        choices={"preset": sorted({run.preset for run in runs}), "data": sorted({run.data for run in runs})},
    )


def _of_fusion(scores: FusionScores) -> str:
    """The depth error with one camera and with all, in words."""
    one, every = (
        SCORES["depth_error_mm"].text(scores.band("depth_error_mm", "mode", k).value) for k in (1, scores.views)
    )
    return f"depth error {one} mm with one camera, {every} mm with {scores.views}"


def _of_tracks(scores: Mapping[str, TrackScores]) -> str:
    """The depth error of single frames and of the path, in words."""
    shortest = min(scores.values(), key=lambda each: (each.frames, each.cameras))
    bands = (shortest.bands[f"depth_error_mm/{method}"].value for method in ("single", "slow"))
    single, path = map(SCORES["depth_error_mm"].text, bands)
    return f"depth error {single} mm in single frames, {path} mm on paths of {shortest.frames}"


def run_page(drawn: Drawn, several: bool, tables: Sequence[Table]) -> str:
    """The page of one run, with its own tables of several cameras and of paths."""
    run = drawn.run
    own = {table.kind: table for table in tables for kind in ("fusion", "tracks") if table.stem == _stem(kind, run)}
    return _ENVIRONMENT.get_template("run.html").render(
        root="../",
        several=several,
        run=run,
        measured=run.measured,
        scores=(rows := _score_rows(run)),
        headlines=[row for key in HEADLINES for row in rows if row["key"] == key],
        environment=_environment(run),
        charts=drawn.charts,
        own=own,
    )


def _stem(kind: str, run: Run) -> str:
    return file_stem(kind, run.preset, run.data, run.model, run.name)


def _environment(run: Run) -> dict[str, str]:
    """Machine, commit, data set and versions."""
    if (status := run.status) is None:
        return {}
    known = {"machine": status.machine, "git commit": status.git_commit, "data set": status.data_manifest}
    return {name: value or "unknown" for name, value in known.items()} | status.versions


def comparison_page(runs: Sequence[Run]) -> str:
    """`compare.html`: any two runs side by side."""
    quantities = {key: asdict(score) for key, score in SCORES.items()}
    template = _ENVIRONMENT.get_template("compare.html")
    return template.render(root="", several=True, runs=runs, quantities=quantities)


def _score_rows(run: Run) -> list[dict[str, Any]]:
    """The lines of a run's table of numbers, in the order of `SCORES`."""
    before, after = run.measured.before, run.measured.after
    if before is None:
        return []
    published = PUBLISHED.get((run.model, run.data), {})
    paper = {f"{name}_error_mm": value for name, value in published.items()}
    recalibrated = after.scores if after else {}
    return [
        {"key": name, "quantity": score, "before": before.scores[name], "after": recalibrated.get(name)}
        | {"reference": before.reference.get(name), "paper": paper.get(name)}
        for name, score in SCORES.items()
        if name in before.scores
    ]


def run_script(drawn: Drawn) -> str:
    """The data of a run's charts and of the comparison."""
    run, before = drawn.run, drawn.run.measured.before
    content = {
        "preset": run.preset, "data": run.data, "model": run.model, "run": run.name, "title": run.title,
        "images": run.measured.images, "config": dict(run.config),
        "scores": {row["key"]: asdict(row["before"]) for row in _score_rows(run)},
        "resampled": {
            name: [float(f"{value:.6g}") for value in values]
            for name, values in (before.resampled if before else {}).items()
        },
        "scene": scene_traces(run.measured.scene) if run.measured.scene else None,
        "charts": {key: vars(chart) for charts in drawn.charts.values() for key, chart in charts.items()},
    }  # fmt: skip
    return as_script(run.slug, content)


def as_script(name: str, content: Any) -> str:
    """`phdExp.receive("<name>", {...});`, a script because pages opened as files may not fetch.

    Safe in HTML and JavaScript: <, >, & and line separators are escaped; NaN and infinity become null.

    Examples:
        >>> as_script("a", {"x": [1.5, float("nan")]})
        'phdExp.receive("a", {"x":[1.5,null]});\\n'
    """
    text = json.dumps(content, separators=(",", ":"))
    if "NaN" in text or "Infinity" in text:
        text = json.dumps(json.loads(text, parse_constant=lambda _: None), separators=(",", ":"))
    text = f"phdExp.receive({json.dumps(name)}, {text});\n"
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text
