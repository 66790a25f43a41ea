"""Each bad input of the table is one line: never a traceback, never a wait, and nothing of it is run."""

import html
import re
from collections.abc import Callable

import pytest

from tests.bad_input.place import Place
from tests.bad_input.table import TABLE, Bad

PROGRESS = ("verifying ", "decoding ")


CASES = [pytest.param(bad, id=bad.name, marks=[pytest.mark.slow] * bad.again) for bad in TABLE]


@pytest.mark.timeout(60)
@pytest.mark.parametrize("bad", CASES)
def test_one_line(place: Place, phd_exp: Callable, monkeypatch: pytest.MonkeyPatch, bad: Bad) -> None:
    monkeypatch.setenv("COLUMNS", "1000")  # a report breaks no line
    bad.spoil(place)
    run = str(place.run.path.relative_to(place.root))
    outcome = phd_exp(*(word.replace("RUN", run) for word in bad.words))
    assert "Traceback" not in outcome.out + outcome.err
    assert outcome.status == bad.status, outcome.err
    assert not (place.root / "owned").exists()
    if bad.status:
        lines = [line for line in outcome.err.splitlines() if not line.startswith(PROGRESS)]
        (line,) = lines
        assert re.fullmatch(f"error: (?:{bad.said})", line), line
    else:
        pages = [html.unescape(page.read_text()) for page in place.root.glob("report/site/runs/*.html")]
        assert re.search(bad.said, "\n".join([outcome.out, *pages])), outcome.out


def test_every_bad_input_has_a_name_of_its_own() -> None:
    assert len({bad.name for bad in TABLE}) == len(TABLE) >= 60
