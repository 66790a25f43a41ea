"""The site in a real browser, from the file system, without a network.

By default one walk on a phone; all other pages and interactions are slow.
"""

import re
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from tests.support.browser import Visit
from tests.support.recorded import sited
from tests.support.site_runs import OWNED
from tests.support.synthetic import write_run

RUN = "runs/small-default-probabilistic-seed0.html"
OTHER = "small-occl-probabilistic-seed0"
FAILED = "runs/small-occl-mae_vz-seed0.html"
COMPARISON = f"compare.html#a=small-default-probabilistic-seed0&b={OTHER}"
PHONE_DARK = {"viewport": {"width": 360, "height": 740}, "color_scheme": "dark", "has_touch": True}
LAPTOP = {"viewport": {"width": 1280, "height": 800}, "color_scheme": "light"}
LONGEST_LINES = """plots => plots.map(plot => Math.max(
    ...[...plot.querySelectorAll('.scatterlayer path')].map(path => path.getTotalLength())
))"""
"""The longest line, band or point of each chart: zero for an empty frame."""


BAD = "main img[src=x], main svg[onload], a[href^='javascript']"
"""What a text of a run must not become."""


def _opens_and_draws(visit: Visit, page: str) -> int:
    visit.open(page)
    charts = visit.draw()
    drawn = visit.page.locator("figure.drawn .plot").evaluate_all(LONGEST_LINES)
    assert len(drawn) == charts
    assert min(drawn, default=1) > 0, page
    assert visit.width_beyond() <= 0, f"{page} is wider than the screen"
    visit.open_details()
    assert visit.page.locator(BAD).count() == 0, page
    assert visit.page.evaluate("window.owned === undefined"), page
    return charts


@pytest.mark.slow
def test_charts_outside_the_view_draw_themselves(visit: Visit) -> None:
    """A screenshot of the whole page has all charts."""
    visit.open("index.html")
    visit.page.wait_for_function(
        "[...document.querySelectorAll('figure.chart')].every(it => !it.clientWidth || it.matches('.drawn'))"
    )
    assert visit.page.locator("figure.drawn").count() > 0
    assert visit.page.evaluate("window.scrollY") == 0


@pytest.mark.parametrize("visit", [PHONE_DARK], ids=["phone, dark"], indirect=True)
def test_pages_of_each_kind_open_and_draw_their_charts(visit: Visit) -> None:
    overview, run, comparison, failed = (
        _opens_and_draws(visit, page) for page in ("index.html", RUN, COMPARISON, FAILED)
    )
    assert overview > 0
    assert comparison > run > 0, "the other run has charts of several cameras too"
    assert failed == 0, "a single evaluation is no curve"


@pytest.mark.slow
def test_logarithmic_axes_say_so_and_have_one_format_of_ticks(visit: Visit) -> None:
    visit.open(RUN)
    visit.draw()
    for chart in ("depth_calibration", "projected_calibration", "learning_projected_precision"):
        figure = visit.page.locator(f"figure[data-chart={chart}]")
        assert "log scale" in figure.locator(".ytitle").text_content()
        ticks = figure.locator(".ytick text").evaluate_all("ticks => ticks.map(tick => tick.innerHTML)")
        assert len(ticks) > 1
        assert len({"super" in tick or "10<tspan" in tick for tick in ticks}) == 1, ticks


@pytest.mark.slow
@pytest.mark.parametrize("visit", [LAPTOP, PHONE_DARK], ids=["laptop, light", "phone, dark"], indirect=True)
def test_every_page_opens_and_draws_its_charts(visit: Visit, site: Path) -> None:
    """The labels under the mouse are texts of the run too."""
    slugs = sorted(file.stem for file in (site / "runs").iterdir())
    for page in (f"compare.html#a={slugs[0]}&b={slugs[1]}", *(f"runs/{quote(slug)}.html" for slug in slugs)):
        _opens_and_draws(visit, page)
        for axes in visit.page.locator(".plot .nsewdrag").all()[:3]:
            axes.hover(force=True, timeout=2000)
        assert visit.page.evaluate("window.owned === undefined"), page
    visit.open(f"runs/{OTHER}.html")  # the text reads as it was written
    text = visit.page.locator("main").text_content() or ""
    assert text.count(f"'\"><img src=x onerror={OWNED}>") > 5
    assert "{{7*7}}" in text


@pytest.mark.slow
@pytest.mark.parametrize("visit", [LAPTOP, PHONE_DARK], ids=["laptop, light", "phone, dark"], indirect=True)
def test_a_test_image_is_drawn_in_space(visit: Visit) -> None:
    """To scale, and a close-up without the camera; also after a change of the theme."""
    visit.open(RUN)
    figure = visit.page.locator("figure.scene")
    figure.scroll_into_view_if_needed()
    colours = []
    for _ in range(2):
        visit.page.wait_for_selector("figure.scene.drawn")
        assert figure.locator("canvas").count() >= 2
        names = figure.locator(".plot").evaluate_all("plots => plots.map(plot => plot.data.map(({ name }) => name))")
        assert set(names[0]) - set(names[1]) == {"camera and the edges of its image"}
        colours.append(figure.locator(".plot").first.evaluate("plot => plot.data[1].color"))
        visit.page.evaluate("document.querySelector('figure.scene').classList.remove('drawn')")
        visit.page.get_by_role("button", name="Dark theme").click()
    assert colours[0] != colours[1]
    assert visit.width_beyond() <= 0


@pytest.mark.slow
def test_links_and_the_comparison_keep_their_runs(visit: Visit) -> None:
    visit.open("index.html")
    visit.page.get_by_role("link", name="probabilistic on default").first.click()
    visit.page.wait_for_url(f"**/{RUN}")
    visit.page.get_by_role("link", name="Compare with another run").click()
    visit.page.wait_for_url("**/compare.html**")
    assert visit.page.locator("#run-a").input_value() == "small-default-probabilistic-seed0"
    visit.page.locator("#run-b").select_option(OTHER)
    visit.page.wait_for_function(f"location.hash.endsWith('{OTHER}')")
    scores = visit.page.locator("#scores table")
    before = scores.locator("tbody tr").first.inner_text().split("\t")
    assert before[0] == "Projected error (mm)"
    visit.page.get_by_role("button", name="Swap").click()
    visit.page.wait_for_function("location.hash.startsWith('#a=small-occl')")
    scores.locator("tbody tr").first.get_by_text(before[2]).first.wait_for()
    visit.page.wait_for_timeout(200)  # the table is drawn after the address changes
    after = scores.locator("tbody tr").first.inner_text().split("\t")
    assert [after[1], after[2]] == [before[2], before[1]]
    assert "data.spec.variant" in visit.page.locator("#config").inner_text()
    visit.page.get_by_role("link", name="Overview").click()
    visit.page.wait_for_url("**/index.html")


@pytest.mark.slow
def test_a_comparison_has_paired_differences_and_names_its_runs(visit: Visit) -> None:
    """Only runs on the same test images are compared image by image."""
    visit.open("compare.html#a=small-default-probabilistic-seed0&b=small-default-mae_logz-seed0")
    row = visit.page.locator("#scores tbody tr").first
    row.wait_for()
    assert re.fullmatch(r"−?\d+\.\d \[−?\d+\.\d, −?\d+\.\d\]", row.inner_text().split("\t")[3])
    assert "tested on the same images" in visit.page.locator("#paired").inner_text()
    visit.open("about:blank")
    visit.open(COMPARISON)
    legend = visit.page.locator("#curves figure[data-chart=coverage] .legend li")
    legend.first.wait_for()
    texts = legend.all_inner_texts()
    assert [text[:2] for text in texts if text[1] == ":"] == ["A:", "B:"]
    assert "probabilistic on default seed0" in texts[1]


@pytest.mark.slow
def test_the_overview_sorts_runs_and_filters_lines(visit: Visit) -> None:
    visit.open("index.html")
    assert visit.page.locator("main section").first.get_attribute("id") == "runs"
    column = "[...document.querySelectorAll('table.runs tbody tr')].map(row => Number(row.cells[3].dataset.value))"
    button = visit.page.locator("table.runs thead button").nth(3)
    for sign in (1, -1):
        button.click()
        values = [value for value in visit.page.evaluate(column) if value is not None]
        assert len(values) > 2
        assert values == sorted(values, key=lambda value: sign * value)
    assert button.locator("..").get_attribute("aria-sort") == "descending"
    names = visit.page.locator("#learning .legend.runs li").all_inner_texts()
    assert "small/default/probabilistic/seed0" in [name.strip() for name in names]
    visit.draw()
    lines = visit.page.locator("[data-chart=calibration_coverage] .scatterlayer .trace")
    every = lines.count()
    visit.page.locator("[data-filter=data]").select_option("occl")
    visit.page.wait_for_function(
        f"document.querySelectorAll('[data-chart=calibration_coverage] .scatterlayer .trace').length < {every}"
    )
    assert lines.count() == 2  # the diagonal and one run
    rows = visit.page.locator("table.runs tbody tr:visible th")
    assert 0 < rows.count() < visit.page.locator("table.runs tbody tr").count()
    assert all(" on occl" in text for text in rows.all_inner_texts())


@pytest.mark.slow
def test_at_most_eight_lines_have_a_label(chromium: Any, tmp_path: Path) -> None:
    """The others are grey; a filter labels others."""
    for place in range(10):
        write_run(tmp_path / "runs", ("default", "occl")[place > 7], "mae_vz", seed=place, n=40, epochs=2)
    visit = Visit(chromium, sited(tmp_path / "runs", tmp_path / "out"))
    visit.open("index.html")
    visit.draw()
    labels = visit.page.locator("#learning .legend li[data-run]:visible")
    strokes = """[...document.querySelectorAll('[data-chart$=learning_depth_error_mm] .scatterlayer .js-line')]
        .map(line => line.style.stroke + line.style.strokeDasharray)"""
    every = visit.page.evaluate(strokes)
    assert (labels.count(), len(every), len(set(every))) == (8, 10, 9)
    assert "2 more runs" in visit.page.locator("#learning .more").inner_text()
    visit.page.locator("[data-filter=data]").select_option("occl")
    visit.page.wait_for_function(f"{strokes}.length === 2")
    assert len(set(visit.page.evaluate(strokes))) == labels.count() == 2
    assert not visit.page.locator("#learning .more").is_visible()
    visit.context.close()
    assert visit.faults == []


@pytest.mark.slow
def test_a_chart_has_its_numbers_as_a_table_and_as_csv(visit: Visit) -> None:
    visit.open(RUN)
    figure = visit.page.locator("figure[data-chart=coverage]")
    figure.locator("summary").click()
    rows = figure.locator("tbody tr")
    rows.first.wait_for()
    head = [cell.inner_text() for cell in figure.locator("thead th").all()]
    assert head == ["line", "credible level", "share of truths inside", "low", "high"]
    assert rows.count() > 10
    with visit.page.expect_download() as download:
        figure.get_by_role("link", name="Download as CSV").click()
    assert len(Path(download.value.path()).read_text().splitlines()) == rows.count() + 1


@pytest.mark.slow
def test_the_theme_is_kept_and_applied_to_charts(visit: Visit) -> None:
    visit.open(RUN)
    visit.draw()
    stroke = "getComputedStyle(document.querySelector('[data-chart=coverage] .xtick text')).fill"
    paper = "getComputedStyle(document.body).backgroundColor"
    light = [visit.page.evaluate(colour) for colour in (stroke, paper)]
    button = visit.page.get_by_role("button", name="Dark theme")
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    visit.page.wait_for_function(f"{stroke} !== '{light[0]}'")
    assert visit.page.evaluate(paper) != light[1]
    visit.open("index.html")
    assert visit.page.locator("html").get_attribute("data-theme") == "dark"


@pytest.mark.slow
def test_several_cameras_have_their_charts_and_table(visit: Visit) -> None:
    visit.open("index.html")
    visit.page.locator("#of-fusion a").click()
    visit.page.wait_for_url(f"**/runs/{OTHER}.html#fusion")
    visit.draw()
    section = visit.page.locator("section[aria-labelledby=fusion-title]")
    assert section.locator("figure.drawn").count() == section.locator("figure.chart").count() > 0
    names = section.locator("[data-chart=fusion_depth_error_mm] .legend li")
    assert "Huber, mean, ground" in names.all_inner_texts()
    headings = ["quantity", "method", "1 camera", "2 cameras", "3 cameras", "4 cameras"]
    assert section.locator("table thead th").all_inner_texts() == headings


@pytest.mark.slow
def test_the_keyboard_reaches_the_content_first_and_pictures_are_loaded(visit: Visit) -> None:
    visit.open(RUN)
    visit.page.keyboard.press("Tab")
    assert visit.page.evaluate("document.activeElement.textContent") == "Skip to the content"
    visit.page.keyboard.press("Enter")
    assert visit.page.evaluate("document.activeElement.id") == "main"
    assert visit.page.locator("svg.panel image").count() >= 12
    loaded = visit.page.evaluate(
        """() => Promise.all([...document.querySelectorAll('svg.panel image')].map(image => {
            const copy = new Image(); copy.src = new URL(image.getAttribute('href'), location.href);
            return copy.decode().then(() => copy.naturalWidth);
        }))"""
    )
    assert set(loaded) == {56}
    assert visit.page.locator("svg.birds-eye").count() == 12
    assert visit.page.locator("svg.panel:not([aria-label])").count() == 0
