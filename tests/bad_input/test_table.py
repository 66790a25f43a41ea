"""Each bad input of the table causes one line: no traceback, no wait, and no execution of its content."""

import html
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.bad_input.place import Place, copied
from tests.bad_input.table import REPORT, TABLE, Bad

PROGRESS = ("verifying ", "decoding ")
CASES = [bad for bad in TABLE if bad.words != REPORT]
RUNS = [bad for bad in TABLE if bad.words == REPORT]


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "bad", [pytest.param(bad, id=bad.name, marks=[pytest.mark.slow] * bad.again) for bad in CASES]
)
def test_one_line(place: Place, phd_exp: Callable, bad: Bad) -> None:
    bad.spoil(place)
    run = str(place.run.path.relative_to(place.root))
    outcome = phd_exp(*(word.replace("RUN", run) for word in bad.words))
    assert "Traceback" not in outcome.out + outcome.err
    assert outcome.status == bad.status, outcome.err
    assert not (place.root / "owned").exists()
    (line,) = [line for line in outcome.err.splitlines() if not line.startswith(PROGRESS)]
    assert re.fullmatch(f"error: (?:{bad.said})", line), line


@pytest.mark.timeout(120)
def test_the_page_of_each_bad_run_names_its_fault_and_the_report_goes_on(
    sound: Path, tmp_path: Path, phd_exp: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies of the run, each with one fault, and a sound one, in one report."""
    monkeypatch.setenv("COLUMNS", "1000")  # a report breaks no line
    places = [copied(sound, tmp_path / f"place{number}") for number in range(len(RUNS) + 1)]
    for place, bad in zip(places, RUNS, strict=False):
        bad.spoil(place)
    names = [f"seed{number}-0123abcd" for number in range(len(places))]
    for place, name in zip(places, names, strict=True):
        target = tmp_path / "runs/smoke/folder/probabilistic" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(place.run.path, target)
    outcome = phd_exp(*REPORT)
    assert outcome.status == 0, outcome.err
    assert "Traceback" not in outcome.out + outcome.err
    pages = [
        html.unescape(*[page.read_text() for page in tmp_path.glob(f"report/site/runs/*{name}*.html")])
        for name in names
    ]
    for page, bad in zip(pages, RUNS, strict=False):
        assert re.search(bad.said, f"{outcome.out}\n{page}"), bad.name
    assert "unreadable" not in pages[-1]


def test_names_are_unique() -> None:
    assert len({bad.name for bad in TABLE}) == len(TABLE) >= 60
