"""Files of a site: complete, small, escaped, linked."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from phd_exp.records.runs import RunFolder
from phd_exp.reports.quantities import SCORES
from phd_exp.reports.report import read_report
from phd_exp.reports.runs import Run
from phd_exp.reports.site import build
from phd_exp.reports.site.overview import presets_of
from phd_exp.reports.site.pages import overview_page
from phd_exp.reports.table import Table
from tests.support.recorded import sited
from tests.support.site_runs import HOSTILE, OWNED
from tests.support.synthetic import write_run

MEGABYTE = 1_000_000


class Page(HTMLParser):
    """The links and tags of a page."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(file.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.tags.append((tag, named))
        self.links += [named[key] or "" for key in ("href", "src") if key in named and tag != "use"]

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.tags)


def _pages(site: Path) -> list[Path]:
    return sorted(site.rglob("*.html"))


@pytest.fixture(scope="module")
def runs(shared: Path) -> tuple[Run, ...]:
    return read_report(shared / "runs", shared / "out" / "measured").runs


def test_links_point_to_files_and_pages_load_little(site: Path) -> None:
    for file in _pages(site):
        total = file.stat().st_size
        for link in set(Page(file).links):
            parts = urlsplit(link)
            assert parts.scheme in ("", "data"), f"{file}: {link} needs a network"
            if parts.path and not parts.scheme:
                target = file.parent / unquote(parts.path)
                assert target.exists(), f"{file}: {link}"
                total += target.stat().st_size if target.suffix in (".js", ".css", ".webp") else 0
        assert total < 6 * MEGABYTE, file


def test_every_page_has_an_outline(site: Path) -> None:
    for file in _pages(site):
        page = Page(file)
        assert [page.count(tag) for tag in ("h1", "main", "header", "footer", "title")] == [1] * 5
        assert ("html", {"lang": "en"}) in page.tags
        assert all(named.get("aria-label") for _, named in page.tags if named.get("role") == "img")
        ids = [named["id"] for _, named in page.tags if "id" in named]
        assert len(ids) == len(set(ids))


def _luminance(colour: str) -> float:
    """Relative luminance of a colour #rrggbb (WCAG 2.2)."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colours_contrast_with_the_page(site: Path, theme: str) -> None:
    style = (site / "assets" / "report.css").read_text()
    (block,) = re.findall(rf':root\[data-theme="{theme}"\] {{(.*?)}}', style, re.DOTALL)
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block))
    texts = dict.fromkeys(("ink", "quiet", "link", "good", "bad", "wait"), 4.5)
    lines = {f"series-{place}": 3.0 for place in range(8)}
    for name, least in (texts | lines).items():
        for ground in ("paper", "raised"):
            low, high = sorted((_luminance(colours[name]), _luminance(colours[ground])))
            assert (high + 0.05) / (low + 0.05) >= least, f"{name} on {ground}"


def test_text_of_runs_is_escaped_and_files_have_plain_names(site: Path) -> None:
    for file in _pages(site):
        for tag, named in Page(file).tags:
            assert not [name for name in named if name.startswith("on")], f"{file}: {tag}"
            assert not [link for link in named.values() if link == "x" or str(link).startswith("javascript")], file
    texts = [file.read_text() for folder in ("runs", "data") for file in (site / folder).iterdir()]
    assert sum("&lt;img src=x" in text or "\\u003cimg src=x" in text for text in texts) > 4
    assert not [text for text in texts if HOSTILE in text or f"<script>{OWNED}" in text]
    for file in site.rglob("*"):
        assert file.name.isascii()
        assert not set(file.name) & set("<>\"'&;\\ "), file


def test_every_run_has_a_page_in_any_state(runs: tuple[Run, ...], site: Path) -> None:
    assert {run.state for run in runs} == {"finished", "failed", "interrupted", "unreadable"}
    pages = {run.slug: (site / "runs" / f"{run.slug}.html").read_text() for run in runs}
    assert all(f">{run.state}</span>" in pages[run.slug] for run in runs)
    assert "Traceback (most recent call last)" in pages["small-occl-mae_vz-seed0"]
    assert "the same command resumes it" in pages["small-scale-probabilistic-seed0"]


def script(site: Path, slug: str) -> dict:
    """The data of a page's charts."""
    text = (site / "data" / f"{slug}.js").read_text()
    return json.loads(text[text.index(", ") + 2 : -3])


def test_a_run_page_shows_its_numbers_and_pictures(runs: tuple[Run, ...], site: Path) -> None:
    (run,) = (run for run in runs if run.slug == "small-default-probabilistic-seed0")
    assert run.nll is not None
    assert script(site, run.slug)["scores"]["nll"]["value"] == pytest.approx(run.nll)
    page = (site / "runs" / f"{run.slug}.html").read_text()
    assert f"{run.nll:.2f}".replace("-", "−") in page
    sections = ("gallery", "calibration", "learning", "strata", "numbers")
    places = [page.index(f'id="{name}"') for name in sections]
    assert places == sorted(places)


def test_values_outside_the_calibrated_interval_are_marked(site: Path, runs: tuple[Run, ...]) -> None:
    """In the headlines, which include the coverage, and in the table of all numbers."""
    marked = {}
    for slug in ("small-default-probabilistic-seed0", "small-occl-probabilistic-seed0"):
        (run,) = [run for run in runs if run.slug == slug]
        before, page = run.measured.before, (site / "runs" / f"{slug}.html").read_text()
        assert before is not None
        for key in ("inside_90", "miscalibration_area"):
            value, band = before.scores[key].value, before.reference[key]
            arrow = "↓" if value < band.low else "↑" if value > band.high else ""
            (cell,) = re.findall(f'row">{SCORES[key].label}.*?data-label="Value">(.*?)</td>', page, re.DOTALL)
            assert [one for one in "↓↑" if one in cell] == [*arrow]
            marked[slug, key] = arrow
        headline = page.split('class="headline"')[1].split("</section>")[0]
        assert re.findall('class="what">([^<]*)', headline)[-2:] == [SCORES["inside_90"].label, SCORES["nll"].label]
    assert len(set(marked.values())) == 3  # also a value inside


def test_tables_of_the_best_preset_are_open_and_those_of_smoke_closed() -> None:
    counts = {"smoke": 3, "demo": 1, "small": 2}
    names = [(preset, f"seed{k}") for preset, n in counts.items() for k in range(n)]
    runs = [
        Run(RunFolder(Path(preset, "default", "mae_vz", name)), preset, "default", "mae_vz", name, state="finished")
        for preset, name in names
    ]
    runs += [
        Run(RunFolder(Path("full", "default", "mae_vz", name)), "full", "default", "mae_vz", name, state="failed")
        for _, name in names
    ]
    presets = presets_of(runs)
    assert presets == ["small", "demo", "full", "smoke"]
    tables = [Table("stem", "calibration", preset, (), (), (), (), preset=preset) for preset in sorted(presets)]
    pattern = r'<details class="preset"( open)?>\s*<summary>Preset <strong>(\w+)'
    for made, expected in ((tables, [" open", "", "", ""]), (tables[-1:], [""])):
        found = re.findall(pattern, overview_page(runs, made, {}, []))
        assert [name for _, name in found] == [name for name in presets if name in {table.preset for table in made}]
        assert [is_open for is_open, _ in found] == expected


def test_recalibration_is_shown_with_held_out_samples(site: Path) -> None:
    chart = script(site, "small-occl-probabilistic-seed0")["charts"]["depth_calibration"]
    assert [trace["name"] for trace in chart["data"]] == ["calibrated", "as predicted", "recalibrated"]
    page = (site / "runs" / "small-occl-probabilistic-seed0.html").read_text()
    assert "Recalibrated</th>" in page
    assert "Calibrated</th>" in page


def test_different_runs_have_different_slugs(tmp_path: Path) -> None:
    folders = ("a/b-c/d", "a-b/c/d", "a/b c/d", "a/b?c/d", "a/b/c-d")
    for names in folders:
        folder = tmp_path / names / "seed0"
        folder.mkdir(parents=True)
        (folder / "status.json").write_text("{")
    slugs = [run.slug for run in read_report(tmp_path).runs]
    assert len({slug.lower() for slug in slugs}) == len(folders)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", slug) for slug in slugs)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """Two runs and their site, which a test may change."""
    write_run(tmp_path / "runs", "default", "mae_vz", n=40, epochs=2)
    write_run(tmp_path / "runs", "occl", "mae_vz", n=40, epochs=2)
    sited(tmp_path / "runs", tmp_path / "out")
    return tmp_path


def test_removed_runs_leave_no_page_and_a_single_run_is_not_compared(own: Path) -> None:
    site = own / "out" / "site"
    assert "compare.html" in (site / "index.html").read_text()
    shutil.rmtree(own / "runs" / "small" / "occl")
    sited(own / "runs", own / "out")
    assert not list(site.rglob("*occl*"))
    assert "occl-mae_vz" not in (site / "index.html").read_text()
    others = [page for page in site.rglob("*.html") if page.name != "compare.html"]
    assert not [page for page in others if "compare.html" in page.read_text()]


def test_an_interrupted_report_leaves_the_old_pages(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = own / "out" / "site"
    before = {file: file.read_bytes() for file in _pages(site)}

    def killed(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "run_page", killed)
    with pytest.raises(KeyboardInterrupt):
        sited(own / "runs", own / "out")
    assert {file: file.read_bytes() for file in _pages(site)} == before
    monkeypatch.undo()
    sited(own / "runs", own / "out")
    assert {file: file.read_bytes() for file in _pages(site)} == before


def test_figures_for_a_paper(shared: Path) -> None:
    drawn = {file.name for file in (shared / "out" / "figures").iterdir()}
    names = ("calibration-small", "precision-small", "level_curves-small-default")
    assert drawn == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")} | {".report.written"}
