"""The documentation as `make docs` builds it: without a warning, and read from the disk without a network."""

import html
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import PAGES, REFERENCE, ROOT
from tests.support.browser import Visit

pytestmark = pytest.mark.slow

LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
"""Tags that make a browser fetch something, and the attribute with its address."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stderr
    return folder


class _Loaded(HTMLParser):
    """What a page makes a browser fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        value = dict(attrs).get(LOADED.get(tag, ""))
        if value:
            self.addresses.append(value)


def test_every_page_is_built_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) == len(PAGES) + len(REFERENCE) + 1  # and 404.html
    for page in pages:
        loaded = _Loaded()
        loaded.feed(page.read_text())
        assert loaded.addresses
        assert [address for address in loaded.addresses if re.match(r"(\w+:)?//", address)] == [], page


def test_styles_load_nothing_from_elsewhere(site: Path) -> None:
    for style in site.rglob("*.css"):
        assert re.findall(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", style.read_text()) == [], style


def test_shapes_stand_in_the_reference(site: Path) -> None:
    for package, shape in (
        ("distributions", 'mu_xy: Float[Tensor, "*batch 2"]'),
        ("metrics", 'at: Float[Tensor, "points"]'),
    ):
        texts = [page.read_text() for page in (site / "api" / package).glob("*.html")]
        assert any(shape in html.unescape(re.sub(r"<[^>]+>", "", text)) for text in texts)


def test_formulas_are_drawn_by_the_browser(site: Path) -> None:
    assert all("<math" in (site / "ideas" / f"{page}.html").read_text() for page in ("charts", "density"))


def test_the_front_page_shows_a_picture_and_pages_lead_on(site: Path) -> None:
    front, guide = (site / "index.html").read_text(), (site / "guides" / "train.html").read_text()
    for picture in re.findall(r'<img [^>]*src="([^":]*)"', front):
        assert (site / picture).is_file()
    assert "renders/glance.png" in front
    assert all(f"md-footer__link--{way}" in guide for way in ("prev", "next"))
    assert guide.count('name="__palette"') == 3  # the system's colours, light, dark


@pytest.fixture
def visit(chromium: Any, site: Path) -> Iterator[Visit]:
    visited = Visit(chromium, site)
    yield visited
    visited.context.close()
    assert visited.faults == []


def test_the_search_finds_a_name_from_the_file_system(visit: Visit) -> None:
    visit.open("index.html")
    visit.page.click("input.md-search__input")
    visit.page.keyboard.type("quantiles_along")
    visit.page.wait_for_selector(".md-search-result__item")
    visit.page.click(".md-search-result__item a")
    visit.page.wait_for_url("**/api/distributions/*.html*")


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("confidence", "guides/guarantee"),
        ("video", "guides/tracking"),
        ("licence", "index"),
        ("export", "guides/predict"),
        ("mesh", "guides/own_object"),
    ],
)
def test_the_search_finds_a_guide_before_the_reference(visit: Visit, word: str, page: str) -> None:
    visit.open("index.html")
    visit.page.click("input.md-search__input")
    visit.page.keyboard.type(word)
    first = visit.page.wait_for_selector(".md-search-result__item a")
    assert f"{page}.html" in first.get_attribute("href")


def test_numbers_of_a_cell_stay_on_one_line(visit: Visit) -> None:
    visit.page.set_viewport_size({"width": 390, "height": 900})
    visit.open("guides/tables.html")
    assert max(visit.page.eval_on_selector_all("td[style*=right]", _LINES)) < 1.5


_LINES = """cells => cells.map(cell => {
  const range = document.createRange();
  range.selectNodeContents(cell);
  return range.getBoundingClientRect().height / parseFloat(getComputedStyle(cell).lineHeight);
})"""


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("address", ["index", "ideas/density", "guides/tables", "api/index", "api/fusion/fuse"])
def test_no_page_is_wider_than_the_window(visit: Visit, address: str, width: int) -> None:
    visit.page.set_viewport_size({"width": width, "height": 900})
    visit.open(f"{address}.html")
    assert visit.width_beyond() <= 0
