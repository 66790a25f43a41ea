"""Each bad input causes one line: no traceback, no wait, no execution of its content, and nothing is written."""

import json
import shlex
from collections.abc import Callable
from typing import Any

import pytest

from tests.bad_input.place import ONE, Place
from tests.bad_input.table import ARCHIVES, ARGUMENTS, FILES, RECORDS, TYPED, VIEW, packed

pytestmark = pytest.mark.timeout(60)
NEEDS = {"export": "onnxruntime", "search": "optuna"}
"""The packages without which a verb prints nothing else."""


@pytest.fixture
def refuse(place: Place, phd_exp: Callable) -> Callable[..., None]:
    """Require that a command is refused on one line with these words, and writes nothing."""

    def refuse(words: tuple[str, ...], part: str) -> None:
        if words[0] in NEEDS:
            pytest.importorskip(NEEDS[words[0]])
        before = sorted(place.root.iterdir())
        outcome = phd_exp(*map(place.named, words))
        assert outcome.status in (1, 2), outcome
        (line,) = [line for line in outcome.err.splitlines() if not line.startswith(("verifying ", "decoding "))]
        assert line.startswith("error: ")
        assert part in line, line
        assert "Traceback" not in outcome.out
        assert words[0] not in ("predict", "fuse") or outcome.out == ""
        assert outcome.status == 1 or sorted(place.root.iterdir()) == before
        assert not [path for path in ("owned", "renders/default") if (place.root / path).exists()]

    return refuse


@pytest.mark.parametrize("words", TYPED)
def test_words_of_hydra(place: Place, refuse: Callable, words: str) -> None:
    place.put("file", "no folder")
    typed = words.split(" ") if words.isprintable() else [words]
    front = [typed.pop(0)] if typed[0] == "-m" else []
    refuse((*front, "preset=smoke", "logger=none", *typed), TYPED[words])


@pytest.mark.parametrize("words", ARGUMENTS, ids=shlex.join)
def test_arguments(place: Place, refuse: Callable, words: tuple[str, ...]) -> None:
    place.put("space.yaml", "space: {optimizer.lr: 'interval(0.001,0.01)'}\n")
    if words[0] == "fuse":
        place.put("photos/test/metadata.jsonl", json.dumps(VIEW) + "\n")
    refuse(words, ARGUMENTS[words])


@pytest.mark.parametrize(("file", "content", "words", "part"), FILES)
def test_files(place: Place, refuse: Callable, file: str, content: Any, words: tuple[str, ...], part: str) -> None:
    path = place.root / place.named(file)
    if callable(content):
        content(path)
    else:
        place.put(path, content)
    refuse(words, part)


@pytest.mark.parametrize(("spoil", "words", "part"), RECORDS)
def test_records(place: Place, refuse: Callable, spoil: Callable, words: tuple[str, ...], part: str) -> None:
    spoil(place)
    refuse(words, part)


@pytest.mark.parametrize("kind", ARCHIVES)
def test_archives(place: Place, refuse: Callable, kind: str) -> None:
    make, reason = ARCHIVES[kind]
    place.put("run.zip", make(packed(place)))
    refuse(("predict", "run=run.zip", *ONE[2:]), reason)
