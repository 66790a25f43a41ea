"""Each bad input of the table causes one line: no traceback, no wait, and no execution of its content."""

import re
from collections.abc import Callable

import pytest

from tests.bad_input.bad import Bad
from tests.bad_input.place import Place
from tests.bad_input.table import TABLE

PROGRESS = ("verifying ", "decoding ")
NEEDS = {"export": "onnxruntime", "search": "optuna"}
"""The packages without which a verb says nothing else."""


@pytest.mark.timeout(60)
@pytest.mark.parametrize("bad", TABLE, ids=lambda bad: bad.name)
def test_one_line(place: Place, phd_exp: Callable, bad: Bad) -> None:
    if bad.words[0] in NEEDS:
        pytest.importorskip(NEEDS[bad.words[0]])
    bad.spoil(place)
    before = sorted(place.root.iterdir())
    run = str(place.run.path.relative_to(place.root))
    outcome = phd_exp(*(word.replace("RUN", run) for word in bad.words))
    assert "Traceback" not in outcome.out + outcome.err
    assert outcome.status == bad.status, outcome.err
    assert not [path for path in ("owned", "renders/default") if (place.root / path).exists()]
    assert bad.status == 1 or sorted(place.root.iterdir()) == before
    assert bad.words[0] not in ("predict", "fuse") or outcome.out == ""
    (line,) = [line for line in outcome.err.splitlines() if not line.startswith(PROGRESS)]
    assert re.fullmatch(f"error: (?:{bad.said})", line), line


def test_names_are_unique() -> None:
    assert len({bad.name for bad in TABLE}) == len(TABLE)
