"""Writes the site of all runs, each file atomically: an interrupted report leaves pages that open."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from phd_exp.records.written import Written
from phd_exp.reports.measured import Measured, Notes
from phd_exp.reports.report import Report
from phd_exp.reports.runs import Run, unreadable
from phd_exp.reports.site.overview import Drawn, overview_groups
from phd_exp.reports.site.pages import as_script, comparison_page, overview_page, run_page, run_script
from phd_exp.reports.site.run_charts import run_charts
from phd_exp.reports.table import Table

_ASSETS = Path(__file__).parent / "assets"


def write_site(report: Report, tables: Sequence[Table], figures: Sequence[str], site: Path) -> Path:
    """Write the pages; returns `index.html`. Raises OSError if the folder cannot be written.

        site/
            index.html  compare.html
            runs/<slug>.html           a page per run, with its pictures
            data/<slug>.js             the data of its charts; data/overview.js those of the overview
            assets/                    scripts and style of all pages

    Links are relative, so that the folder can be moved.
    """
    with Written(site, "report") as written:
        for asset in sorted(_ASSETS.iterdir()):
            written.write(f"assets/{asset.name}", asset.read_bytes())
        written.write("assets/plotly.min.js", _plotly())
        several = len(report.runs) > 1
        drawn = [_write_run(written, run, several, tables) for run in report.runs]
        groups = overview_groups(drawn, report.searches)
        charts = {key: vars(chart) for group, _ in groups.values() for key, chart in group.items()}
        written.write("data/overview.js", as_script("overview", {"charts": charts}))
        written.write("compare.html", comparison_page(report.runs))
        written.write("index.html", overview_page([one.run for one in drawn], tables, groups, figures))
    return site / "index.html"


def _plotly() -> bytes:
    """Plotly's script, without importing the package, which takes a second."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_bytes()


def _write_run(written: Written, run: Run, several: bool, tables: Sequence[Table]) -> Drawn:
    """Write the files of a run inside its boundary: its page reports what cannot be drawn."""
    notes = Notes(run.notes)
    charts = notes.attempt(partial(run_charts, run)) or {}
    whole, place_alone = replace(run, notes=notes), unreadable(run.folder, notes)
    tries = [Drawn(whole, charts), Drawn(replace(whole, measured=Measured()), {}), Drawn(place_alone, {})]
    drawn, texts = next(
        (one, texts) for one in tries if (texts := notes.attempt(partial(_texts, one, several, tables)))
    )
    written.write(f"runs/{run.slug}.html", texts[0])
    written.write(f"data/{run.slug}.js", texts[1])
    return drawn


def _texts(drawn: Drawn, several: bool, tables: Sequence[Table]) -> tuple[str, str]:
    """The page of a run and its data. Raises whatever the run would raise on the pages of all runs."""
    overview_page([drawn.run], [], overview_groups([drawn]), [])
    comparison_page([drawn.run])
    return run_page(drawn, several, tables), run_script(drawn)
