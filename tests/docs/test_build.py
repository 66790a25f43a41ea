"""The documentation as `make docs` builds it: without a warning, and read from the disk without a network."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import PAGES, REFERENCE, ROOT
from tests.support.browser import Visit

pytestmark = pytest.mark.slow

LOADED = re.compile(
    r"""<(?:script|img|iframe|source|link)\b[^>]*?\b(?:src|href)="([^"]*)"|(?:url\(|@import)\s*['"]?([^'")]*)"""
)
"""Addresses that a browser fetches, in pages and in styles."""


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


def test_every_page_is_built_and_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) == len(PAGES) + len(REFERENCE) + 1  # and 404.html
    for file in (*pages, *site.rglob("*.css")):
        loaded = ["".join(found) for found in LOADED.findall(file.read_text())]
        assert loaded or file.suffix == ".css"
        assert [address for address in loaded if re.match(r"(https?:)?//", address)] == [], file


def test_pages_have_formulas_pictures_and_shapes(site: Path) -> None:
    front = (site / "index.html").read_text()
    assert all((site / picture).is_file() for picture in re.findall(r'<img [^>]*src="([^":]*)"', front))
    assert all("<math" in (site / "ideas" / f"{page}.html").read_text() for page in ("charts", "density"))
    texts = [re.sub(r"<[^>]+>", "", page.read_text()) for page in (site / "api" / "distributions").glob("*.html")]
    assert any("mu_xy: Float[Tensor, &quot;*batch 2&quot;]" in text.replace('"', "&quot;") for text in texts)


@pytest.fixture
def visit(chromium: Any, site: Path) -> Iterator[Visit]:
    visited = Visit(chromium, site)
    yield visited
    visited.context.close()
    assert visited.faults == []


@pytest.mark.parametrize(
    ("word", "page"),
    [("quantiles_along", "api/distributions/"), ("confidence", "guides/guarantee"), ("licence", "index")],
)
def test_the_search_finds_a_guide_before_the_reference(visit: Visit, word: str, page: str) -> None:
    visit.open("index.html")
    visit.page.click("input.md-search__input")
    visit.page.keyboard.type(word)
    first = visit.page.wait_for_selector(".md-search-result__item a")
    assert page in first.get_attribute("href")


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("address", ["index", "ideas/density", "guides/tables", "api/fusion/fuse"])
def test_no_page_is_wider_than_the_window(visit: Visit, address: str, width: int) -> None:
    visit.page.set_viewport_size({"width": width, "height": 900})
    visit.open(f"{address}.html")
    assert visit.width_beyond() <= 0
