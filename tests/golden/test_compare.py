"""Every golden can fail: each number beyond its tolerance is found, and so is each value that is new or gone."""

import json
import math
from pathlib import Path

import pytest

from tests.golden.compare import LEVELS, PLACE, TOLERANCES, compared, read

FILES = [file for file in sorted(PLACE.glob("*/**/*.*")) if file.suffix in (".json", ".jsonl", ".csv", ".webp")]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PLACE).as_posix())
def test_a_change_of_any_number_is_found(file: Path) -> None:
    """Of a picture, a change in an eighth of each side."""
    golden, numbers = {file.name: read(file)}, []

    def other(text: str) -> float:
        numbers.append(text)
        return 1.1 * (number := float(text)) + math.copysign(0.01, number)

    if file.suffix == ".webp":
        found, numbers = {file.name: (picture := read(file))}, ["picture"]
        picture[: len(picture) // 8, : len(picture) // 8] ^= 4 * LEVELS
    else:
        found = json.loads(json.dumps(golden), parse_float=other, parse_int=other)
    written, lines = compared(found, golden, TOLERANCES[file.relative_to(PLACE).parts[0]])
    assert len(lines) == len(numbers) > 0
    assert compared(written, found, ())[1] == []


def test_what_agrees_is_not_written_again() -> None:
    golden = {"a": [1.0, 2.0], "b": "word", "gone": 1}
    found = {"b": "word", "a": [1.0 + 1e-6, 2.1, 3.0], "new": None}
    written, lines = compared(found, golden, [("", 1e-4, 0.0)])
    assert written == {"a": [1.0, 2.1, 3.0], "b": "word", "new": None}
    assert len(lines) == 4  # two items of a, new, gone
