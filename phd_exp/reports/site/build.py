"""The site of all runs: written file by file, each whole, so that a report that is killed leaves pages that open."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path

from plotly.offline import get_plotlyjs

from phd_exp.records.errors import RunError, UserError
from phd_exp.records.files import remove_temporaries, write_atomic
from phd_exp.reports.collect import Records, Run, collect
from phd_exp.reports.site.dossier import Dossier, read_dossier, read_predictions, slug_of
from phd_exp.reports.site.figures import (
    CALIBRATION,
    LEVEL_CURVES,
    PRECISION,
    first_seeds,
    write_figures,
    write_level_curves,
)
from phd_exp.reports.site.gallery import Gallery, make_gallery
from phd_exp.reports.site.overview import overview_groups
from phd_exp.reports.site.pages import comparison_page, overview_page, run_page
from phd_exp.reports.site.run_data import RunData, as_script, gather, key_of, read_script, run_script
from phd_exp.reports.tables import tables
from phd_exp.reports.variations import variation_tables
from phd_exp.threads import one_thread

_ASSETS = Path(__file__).parent / "assets"


@dataclass(frozen=True)
class SiteFolder:
    """Where things lie in a site.

        site/
            index.html  compare.html
            runs/<slug>.html           a page a run
            data/<slug>.js             what its charts show; data/overview.js those of the overview
            images/<slug>/*.webp       of its gallery
            assets/                    scripts and style, shared by all pages

    Pages name each other by relative paths, so that the folder can be moved.
    """

    path: Path

    def page(self, slug: str) -> Path:
        """The page of a run."""
        return self.path / "runs" / f"{slug}.html"

    def script(self, slug: str) -> Path:
        """What the charts of a page show."""
        return self.path / "data" / f"{slug}.js"

    def images(self, slug: str) -> Path:
        """The pictures of a run's gallery."""
        return self.path / "images" / slug

    def make(self) -> None:
        """Make the folders that are missing. Raises OSError."""
        for name in ("runs", "data", "images", "assets"):
            (self.path / name).mkdir(parents=True, exist_ok=True)
        for folder in (self.path, *filter(Path.is_dir, self.path.rglob("*"))):
            remove_temporaries(folder)  # of a process that was killed


def build_site(runs: Path, out: Path) -> Path:
    """Write `<out>/site/` from every run recorded under `runs`; returns its `index.html`.

    A run whose files have not changed since is not read again.

    Raises UserError where the folder cannot be written.
    """
    site = SiteFolder(out / "site")
    try:
        site.make()
        with one_thread():  # tables of a few thousand rows are too small to share
            return _write(site, collect(runs), out / "figures")
    except OSError as error:
        raise UserError(
            f"{site.path}: cannot be written ({error.strerror}); choose another folder by out=DIR"
        ) from None


def _write(site: SiteFolder, records: Records, figures: Path) -> Path:
    for asset in sorted(_ASSETS.iterdir()):
        write_atomic(site.path / "assets" / asset.name, asset.read_bytes())
    write_atomic(site.path / "assets" / "plotly.min.js", get_plotlyjs())
    found = [_write_run(site, run) for run in records.runs]
    drawn = _write_figures(site, records, found, figures)
    groups = overview_groups(found)
    flat = {
        "charts": {key: asdict(chart) for group in groups.values() for key, chart in group.charts.items()}
    }
    write_atomic(site.script("overview"), as_script("overview", flat))
    write_atomic(site.path / "compare.html", comparison_page(found))
    index = site.path / "index.html"
    write_atomic(index, overview_page(found, tables(records), variation_tables(records), groups, drawn))
    _forget(site, [run.slug for run in found])
    return index


def _write_run(site: SiteFolder, run: Run) -> RunData:
    """The page of a run, its images and its data; the data comes last, because it says that the others are there."""
    slug, key = slug_of(run), key_of(run)
    known = read_script(site.script(slug))
    if known and known.key == key and site.page(slug).exists():
        return known
    dossier = read_dossier(run)
    gallery = _gallery(dossier, site.images(slug))
    data = gather(dossier, key)
    write_atomic(site.page(slug), run_page(data, dossier, gallery))
    write_atomic(site.script(slug), run_script(data))
    return data


def _gallery(dossier: Dossier, images: Path) -> Gallery | None:
    if dossier.assessment is None or dossier.predictions is None:
        return None
    try:
        return make_gallery(dossier.predictions, dossier.config, images)
    except RunError as error:
        dossier.notes.append(str(error))
        return None


def _write_figures(site: SiteFolder, records: Records, found: Sequence[RunData], figures: Path) -> list[str]:
    """Draw the figures of every preset in which a run has changed since; names of all that are there."""
    remove_temporaries(figures)
    folders = {slug_of(run): run.folder for run in records.runs}
    names: list[str] = []
    for preset, group in groupby(first_seeds(found), key=lambda run: run.preset):
        of_preset = list(group)
        changed = {run.slug: site.script(run.slug).stat().st_mtime for run in of_preset}
        if _older(figures / f"{CALIBRATION}-{preset}.pdf", max(changed.values())):
            write_figures(preset, of_preset, figures)
        names += [f"{CALIBRATION}-{preset}", f"{PRECISION}-{preset}"]
        for run in of_preset:
            stem = figures / f"{LEVEL_CURVES}-{preset}-{run.data}"
            if _older(stem.with_name(f"{stem.name}.pdf"), changed[run.slug]):
                write_level_curves(read_predictions(folders[run.slug]), run.config, stem)
            names.append(stem.name)
    return [name for name in names if (figures / f"{name}.pdf").exists()]


def _older(file: Path, changed: float) -> bool:
    return not file.exists() or file.stat().st_mtime < changed


def _forget(site: SiteFolder, slugs: Sequence[str]) -> None:
    """Remove what belongs to runs that are no longer there."""
    kept = {*slugs, "overview"}
    for file in [*(site.path / "runs").glob("*.html"), *(site.path / "data").glob("*.js")]:
        if file.stem not in kept:
            file.unlink()
    for folder in (site.path / "images").iterdir():
        if folder.name not in kept:
            for image in folder.iterdir():
                image.unlink()
            folder.rmdir()
