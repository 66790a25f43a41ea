"""Runs whose every text tries to execute code in the reader's browser."""

import json
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from phd_exp.records.runs import RunFolder
from tests.support.browser import Visit
from tests.support.recorded import reported
from tests.support.synthetic import write_run

OWNED = "window.owned=1"
EVIL = (
    f"'\"><img src=x onerror={OWNED}><svg onload={OWNED}></script><script>{OWNED}</script>"
    f'<a href="javascript:{OWNED}">x</a>{{{{7*7}}}}\u2028&lt;b&gt;%3Cb%3E'
)
NAME = EVIL.replace("/", "")
"""The same as a name of a folder or a file."""


def rewrite(folder: RunFolder) -> None:
    """Put it wherever a run record holds a text."""
    folder.config_file.write_text(json.dumps(folder.config() | {EVIL: {EVIL: EVIL}, "model": {"name": EVIL}}))
    status = json.loads(folder.status_file.read_text())
    texts = dict.fromkeys(("machine", "git_commit", "data_manifest", "traceback", "error"), EVIL)
    folder.status_file.write_text(json.dumps(status | texts | {"versions": {EVIL: EVIL}}))
    rows = [row | {EVIL: 1.0, f"test/{EVIL}": float(row["epoch"])} for row in folder.metrics()]
    folder.write_metrics(rows)
    if folder.predictions.exists():
        pd.read_parquet(folder.predictions).assign(file_name=f"{NAME}.png").to_parquet(folder.predictions)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("hostile")
    runs, images = place / "runs", place / "renders" / "default" / "test"
    images.mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 255, (56, 56, 3), dtype=np.uint8)
    Image.fromarray(noise).save(images / (NAME.encode()[:200].decode(errors="ignore") + ".png"))
    rewrite(write_run(runs, "default", n=40, epochs=2, root=place / "renders"))
    rewrite(write_run(runs, NAME[:120], "mae_vz", preset="a<b>'\"&", n=40, epochs=2))
    failed = write_run(runs, "occl", "mae_<script>alert(1)<script>", n=40, epochs=2)
    rewrite(failed)
    failed.status_file.write_text(failed.status_file.read_text().replace('"finished"', '"failed"'))
    reported(runs, place / "out")
    return place / "out" / "site"


def addresses(site: Path) -> list[str]:
    slugs = sorted(file.stem for file in (site / "runs").iterdir())
    pages = [f"runs/{quote(slug)}.html" for slug in slugs]
    return ["index.html", *pages, f"compare.html#a={quote(slugs[0])}&b={quote(slugs[1])}"]


def test_no_text_is_executed_in_a_browser(visit: Visit) -> None:
    found = addresses(visit.site)
    assert len(found) == 5
    for address in found:
        visit.open("about:blank" if visit.page.url == address else address)
        visit.draw()
        visit.open_details()
        for axes in visit.page.locator(".plot .nsewdrag").all()[:3]:  # the labels under the mouse
            axes.hover(force=True, timeout=2000)
        assert visit.page.evaluate("window.owned === undefined"), address
        bad = "main img[src=x], main svg[onload], a[href^='javascript']"
        assert visit.page.locator(bad).count() == 0, address
        if "runs/small-default-probabilistic" in address:  # the text reads as it was written
            text = visit.page.locator("main").text_content() or ""
            assert text.count(f"'\"><img src=x onerror={OWNED}>") > 5
            assert "{{7*7}}" in text


def test_files_of_the_site_have_plain_names(site: Path) -> None:
    for file in site.rglob("*"):
        assert file.name.isascii()
        assert not set(file.name) & set("<>\"'&;\\ "), file
