"""Writes the site of all runs, each file atomically: an interrupted report leaves pages that open."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from plotly.offline import get_plotlyjs

from phd_exp.records.files import remove_temporaries, write_atomic
from phd_exp.reports.measured import Measured, Notes
from phd_exp.reports.runs import Report, Run, unreadable
from phd_exp.reports.site.overview import Drawn, overview_groups
from phd_exp.reports.site.pages import as_script, comparison_page, overview_page, run_page, run_script
from phd_exp.reports.site.run_charts import run_charts
from phd_exp.reports.table import Table, write_text

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
    for folder in (site / "runs", site / "data", site / "assets"):
        folder.mkdir(parents=True, exist_ok=True)
        remove_temporaries(folder)  # of a killed process
    for asset in sorted(_ASSETS.iterdir()):
        write_atomic(site / "assets" / asset.name, asset.read_bytes())
    write_atomic(site / "assets" / "plotly.min.js", get_plotlyjs())
    several = len(report.runs) > 1
    drawn = [_write_run(site, run, several) for run in report.runs]
    groups = overview_groups(drawn, report.searches)
    charts = {key: asdict(chart) for group, _ in groups.values() for key, chart in group.items()}
    write_text(site / "data" / "overview.js", as_script("overview", {"charts": charts}))
    write_text(site / "compare.html", comparison_page(report.runs))
    write_text(site / "index.html", overview_page([one.run for one in drawn], tables, groups, figures))
    kept = {"overview", *(run.slug for run in report.runs)}
    for file in [*(site / "runs").glob("*.html"), *(site / "data").glob("*.js")]:
        if file.stem not in kept:
            file.unlink()
    return site / "index.html"


def _write_run(site: Path, run: Run, several: bool) -> Drawn:
    """Write the files of a run inside its boundary: its page reports what cannot be drawn."""
    notes = Notes(run.notes)
    charts = notes.attempt(partial(run_charts, run)) or {}
    whole, place_alone = replace(run, notes=notes), unreadable(run.folder, notes)
    tries = [Drawn(whole, charts), Drawn(replace(whole, measured=Measured()), {}), Drawn(place_alone, {})]
    drawn, texts = next((one, texts) for one in tries if (texts := notes.attempt(partial(_texts, one, several))))
    write_text(site / "runs" / f"{run.slug}.html", texts[0])
    write_text(site / "data" / f"{run.slug}.js", texts[1])
    return drawn


def _texts(drawn: Drawn, several: bool) -> tuple[str, str]:
    """The page of a run and its data. Raises whatever the run would raise on the pages of all runs."""
    overview_page([drawn.run], [], overview_groups([drawn]), [])
    comparison_page([drawn.run])
    return run_page(drawn, several), run_script(drawn)
