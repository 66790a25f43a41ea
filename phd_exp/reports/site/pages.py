"""HTML of the pages; whatever comes from files is escaped."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from phd_exp.evaluation.predictions import Band
from phd_exp.reports.captions import gap_lines
from phd_exp.reports.fusion_table import fusion_table
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.site.charts import Chart
from phd_exp.reports.site.dossier import Dossier
from phd_exp.reports.site.gallery import Gallery
from phd_exp.reports.site.overview import Group
from phd_exp.reports.site.quantities import SCORES, Quantity, quantity
from phd_exp.reports.site.run_data import RunData
from phd_exp.reports.tables import PaperTable
from phd_exp.reports.variations import VariationTable

_HERE = Path(__file__).parent


@dataclass(frozen=True)
class ScoreRow:
    """One line of a run's table of numbers."""

    quantity: Quantity
    before: Band
    after: Band | None
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
    environment.filters["duration"] = _duration
    environment.globals["gap_lines"] = gap_lines
    return environment


def _moment(moment: datetime) -> str:
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


_ENVIRONMENT = _environment()


def overview_page(
    runs: Sequence[RunData],
    tables: Sequence[PaperTable],
    varied: Sequence[VariationTable],
    groups: dict[str, Group],
    figures: Sequence[str],
) -> str:
    """`index.html`: the tables, the charts of all runs, the list of runs."""
    measured = Counter(table.preset for table in tables for cell in table.sources if cell.mean is not None)
    presets = [preset for preset, _ in measured.most_common()]  # the fullest tables first
    return _ENVIRONMENT.get_template("overview.html").render(
        root="",
        runs=runs,
        fused=[run for run in runs if run.fusion],
        tables=[[table for table in tables if table.preset == preset] for preset in presets],
        varied=varied,
        groups=groups,
        figures=figures,
        finished=sum(run.state == "finished" for run in runs),
        choices={"preset": sorted({run.preset for run in runs}), "data": sorted({run.data for run in runs})},
        score=quantity,
    )


def run_page(run: RunData, dossier: Dossier, gallery: Gallery | None) -> str:
    """The page of one run."""
    context: dict[str, Any] = {
        "root": "../",
        "run": run,
        "dossier": dossier,
        "status": dossier.status,
        "gallery": gallery,
        "scores": _score_rows(run),
        "strata": _strata(dossier),
        "charts": {group: _chosen(run, prefix) for group, prefix in _GROUPS.items()},
        "fusion": fusion_table(dossier.run, dossier.fusion) if dossier.fusion else None,
        "temperature": dossier.assessment.temperature if dossier.assessment else None,
    }
    return _ENVIRONMENT.get_template("run.html").render(**context)


def comparison_page(runs: Sequence[RunData]) -> str:
    """`compare.html`: any two runs side by side."""
    quantities = {key: asdict(score) for key, score in SCORES.items()}
    return _ENVIRONMENT.get_template("compare.html").render(root="", runs=runs, quantities=quantities)


_GROUPS = {"learning": "learning_", "strata": "strata_", "fusion": "fusion_", "calibration": ""}


def _chosen(run: RunData, prefix: str) -> dict[str, Chart]:
    others = tuple(other for other in _GROUPS.values() if other)
    return {
        key: chart
        for key, chart in run.charts.items()
        if (key.startswith(prefix) if prefix else not key.startswith(others))
    }


def _score_rows(run: RunData) -> list[ScoreRow]:
    published = PUBLISHED.get((run.model, run.data))
    return [
        ScoreRow(quantity(key), band, run.recalibrated.get(key), getattr(published, key, None))
        for key, band in run.scores.items()
    ]


def _strata(dossier: Dossier) -> list[tuple[str, int, list[tuple[Quantity, Band]]]]:
    if not dossier.assessment:
        return []
    return [
        (
            f"{stratum.quantity} {stratum.label}",
            stratum.n,
            [(quantity(k), b) for k, b in stratum.scores.items()],
        )
        for stratum in dossier.assessment.before.strata
    ]
