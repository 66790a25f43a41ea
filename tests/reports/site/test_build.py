"""Files of a site: whole, small, escaped, linked; rebuilt only where something changed."""

import re
import shutil
from html.parser import HTMLParser
from itertools import combinations
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from phd_exp.records.errors import UserError
from phd_exp.records.files import write_atomic
from phd_exp.reports import figures
from phd_exp.reports.collect import collect
from phd_exp.reports.site import build
from phd_exp.reports.site.build import build_site
from phd_exp.reports.site.dossier import slug_of
from phd_exp.reports.site.run_data import read_script
from tests.reports.site.conftest import HOSTILE
from tests.reports.site.synthetic import write_run

MEGABYTE = 1_000_000


class Page(HTMLParser):
    """What a page links to, and its outline."""

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


def test_links_point_to_files_that_are_there(site: Path) -> None:
    for file in _pages(site):
        for link in Page(file).links:
            parts = urlsplit(link)
            assert parts.scheme in ("", "data"), f"{file}: {link} wants a network"
            if parts.path and not parts.scheme:
                assert (file.parent / unquote(parts.path)).exists(), f"{file}: {link}"


def test_pages_are_small_with_all_that_they_load(site: Path) -> None:
    for file in _pages(site):
        loaded = [link for link in Page(file).links if link.endswith((".js", ".css", ".webp"))]
        total = file.stat().st_size + sum(
            (file.parent / unquote(link)).stat().st_size for link in set(loaded)
        )
        assert total < 6 * MEGABYTE


def test_every_page_has_an_outline(site: Path) -> None:
    for file in _pages(site):
        page = Page(file)
        assert [page.count(tag) for tag in ("h1", "main", "header", "footer", "title")] == [1] * 5
        assert ("html", {"lang": "en"}) in page.tags
        labelled = [named for tag, named in page.tags if named.get("role") == "img"]
        assert all(named.get("aria-label") for named in labelled)
        ids = [named["id"] for _, named in page.tags if "id" in named]
        assert len(ids) == len(set(ids))


def _luminance(colour: str) -> float:
    """Relative luminance of a colour #rrggbb (WCAG 2.2)."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_colours_stand_out_from_the_page(site: Path, theme: str) -> None:
    style = (site / "assets" / "report.css").read_text()
    (block,) = re.findall(rf':root\[data-theme="{theme}"\] {{(.*?)}}', style, re.DOTALL)
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block))
    texts = dict.fromkeys(("ink", "quiet", "link", "good", "bad", "wait"), 4.5)
    lines = {f"series-{place}": 3.0 for place in range(8)}
    for name, least in (texts | lines).items():
        for ground in ("paper", "raised"):
            low, high = sorted((_luminance(colours[name]), _luminance(colours[ground])))
            assert (high + 0.05) / (low + 0.05) >= least, f"{name} on {ground}"


def test_what_runs_say_is_text(site: Path) -> None:
    pages = {file.name: file.read_text() for file in _pages(site)}
    assert any("&lt;img src=x" in text for text in pages.values())
    for text in [*pages.values(), *(file.read_text() for file in (site / "data").iterdir())]:
        assert HOSTILE not in text
        assert "<script>window" not in text


def test_a_page_for_every_run_whatever_its_state(shared: Path, site: Path) -> None:
    runs = collect(shared / "runs").runs
    assert {run.state for run in runs} == {"finished", "failed", "broken off", "unreadable"}
    for run in runs:
        page = (site / "runs" / f"{slug_of(run)}.html").read_text()
        assert f">{run.state}</span>" in page
    failed = (site / "runs" / "small-occl-mae_vz-seed0.html").read_text()
    assert "Traceback (most recent call last)" in failed
    assert "same command goes on" in (site / "runs" / "small-scale-probabilistic-seed0.html").read_text()


def test_the_numbers_are_those_of_the_evaluation(shared: Path, site: Path) -> None:
    run = read_script(site / "data" / "small-default-probabilistic-seed0.js")
    assert run is not None
    (recorded,) = (r for r in collect(shared / "runs").runs if slug_of(r) == run.slug)
    assert recorded.nll is not None
    assert run.scores["nll"].value == pytest.approx(recorded.nll)
    page = (site / "runs" / f"{run.slug}.html").read_text()
    assert f"{recorded.nll:.2f}".replace("-", "−") in page


def test_recalibration_is_shown_where_samples_were_held_out(site: Path) -> None:
    certain = read_script(site / "data" / "small-occl-probabilistic-seed0.js")
    assert certain is not None
    assert certain.recalibrated["miscalibration_area"].value < certain.scores["miscalibration_area"].value / 2
    names = [trace["name"] for trace in certain.charts["depth_calibration"].data]
    assert names == ["calibrated", "as predicted", "recalibrated"]


def test_slugs_differ_wherever_runs_do(tmp_path: Path) -> None:
    for names in (
        ("a", "b-c", "d"),
        ("a-b", "c", "d"),
        ("a", "b c", "d"),
        ("a", "b?c", "d"),
        ("a", "b", "c-d"),
    ):
        folder = tmp_path.joinpath(*names, "seed0")
        folder.mkdir(parents=True)
        (folder / "status.json").write_text("{")
    slugs = [slug_of(run) for run in collect(tmp_path).runs]
    assert len(slugs) == 5
    assert all(a.lower() != b.lower() for a, b in combinations(slugs, 2))
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", slug) for slug in slugs)


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """Two runs and their site, to be changed."""
    write_run(tmp_path / "runs", "default", "mae_vz", n=40, epochs=2)
    write_run(tmp_path / "runs", "occl", "mae_vz", n=40, epochs=2)
    build_site(tmp_path / "runs", tmp_path / "out")
    return tmp_path


def _times(site: Path) -> dict[str, int]:
    return {file.name: file.stat().st_mtime_ns for file in (site / "runs").iterdir()}


def test_only_runs_that_changed_are_read_again(own: Path) -> None:
    site = own / "out" / "site"
    before = _times(site)
    changed = own / "runs" / "small" / "occl" / "mae_vz" / "seed0"
    (changed / "metrics.jsonl").write_text('{"epoch": 0, "test/loss": 1.0}\n')
    build_site(own / "runs", own / "out")
    after = _times(site)
    assert {name for name in before if before[name] != after[name]} == {"small-occl-mae_vz-seed0.html"}


def test_runs_that_are_gone_leave_nothing(own: Path) -> None:
    shutil.rmtree(own / "runs" / "small" / "occl")
    index = build_site(own / "runs", own / "out")
    assert not [file for file in index.parent.rglob("*occl*") if file.suffix != ".png"]
    assert "occl-mae_vz" not in index.read_text()


def test_a_report_that_is_killed_leaves_the_old_pages(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = own / "out" / "site"
    before = {file: file.read_bytes() for file in _pages(site)}
    (own / "runs" / "small" / "occl" / "mae_vz" / "seed0" / "metrics.jsonl").write_text("")

    def killed(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(build, "run_page", killed)
    with pytest.raises(KeyboardInterrupt):
        build_site(own / "runs", own / "out")
    assert {file: file.read_bytes() for file in _pages(site)} == before
    monkeypatch.undo()
    build_site(own / "runs", own / "out")
    assert _pages(site) == sorted(before)


@pytest.mark.slow
def test_figures_that_a_kill_prevented_are_drawn_by_the_next_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(tmp_path / "runs", n=40, epochs=2)
    files: list[str] = []

    def killed(file: Path, data: bytes) -> None:
        files.append(file.name)
        if len(files) > 2:  # the first figure is there as PNG and PDF, the second is not
            raise KeyboardInterrupt
        write_atomic(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(figures, "write_atomic", killed)
        with pytest.raises(KeyboardInterrupt):
            build_site(tmp_path / "runs", tmp_path / "out")
    build_site(tmp_path / "runs", tmp_path / "out")
    drawn = {file.name for file in (tmp_path / "out" / "figures").iterdir()}
    assert drawn == {
        f"{name}-small.{kind}" for name in ("calibration", "precision") for kind in ("png", "pdf")
    }


def test_no_runs_are_a_page_too(tmp_path: Path) -> None:
    assert "No runs are recorded yet" in build_site(tmp_path, tmp_path / "out").read_text()


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("in the way")
    with pytest.raises(UserError, match="choose another folder by out=DIR"):
        build_site(tmp_path, tmp_path / "out")


def test_figures_for_a_paper(shared: Path) -> None:
    drawn = {file.name for file in (shared / "out" / "figures").iterdir()}
    names = ("calibration-small", "precision-small", "level_curves-small-default")
    assert drawn == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
