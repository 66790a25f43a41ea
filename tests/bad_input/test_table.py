"""Each bad input of the table is one line: never a traceback, never a wait, and nothing of it is run."""

import re
from collections.abc import Callable

import pytest

from tests.bad_input.place import Place
from tests.bad_input.table import TABLE, Bad


@pytest.mark.timeout(60)
@pytest.mark.parametrize("bad", TABLE, ids=lambda bad: bad.name)
def test_one_line(place: Place, phd_exp: Callable, monkeypatch: pytest.MonkeyPatch, bad: Bad) -> None:
    monkeypatch.setenv("COLUMNS", "1000")  # a report breaks no line
    bad.spoil(place)
    outcome = phd_exp(*bad.words)
    assert "Traceback" not in outcome.out + outcome.err
    assert outcome.status == bad.status, outcome.err
    assert not (place.root / "owned").exists()
    if bad.status:
        (line,) = outcome.err.splitlines()
        assert re.fullmatch(f"error: (?:{bad.said})", line), line
    else:
        assert re.search(bad.said, outcome.out), outcome.out


def test_every_bad_input_has_a_name_of_its_own() -> None:
    assert len({bad.name for bad in TABLE}) == len(TABLE) >= 60
