"""No release that is known to be bad can be installed, and the check of that sees one."""

import copy
import runpy
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
problems = runpy.run_path(str(ROOT / ".ci" / "audit.py"))["problems"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = (ROOT / "constraints.txt").read_text()


def test_pins_and_floors_are_sound() -> None:
    assert list(problems(PROJECT, PINS)) == []


@pytest.mark.parametrize(
    ("good", "bad", "said"),
    [
        ("lightning==2.6.6", "lightning==2.6.3", "lightning==2.6.3 is known to be bad: "),
        ("filelock==4.2.11", "filelock==3.16.0", "filelock==3.16.0 is known to be bad"),
        ("hydra-core==1.3.8", "hydra-core==1.4.0", "hydra-core==1.4.0 is not <1.4,>=1.3.4, as pyproject.toml asks"),
    ],
)
def test_a_bad_pin_is_seen(good: str, bad: str, said: str) -> None:
    assert good in PINS
    assert any(said in line for line in problems(PROJECT, PINS.replace(good, bad)))


def test_a_low_floor_is_seen() -> None:
    project = copy.deepcopy(PROJECT)
    names = [text for text in project["project"]["dependencies"] if not text.startswith("pillow")]
    project["project"]["dependencies"] = [*names, "pillow>=11"]
    assert [line for line in problems(project, PINS) if "pillow" in line] == [
        "pyproject.toml: pillow>=11 lets 11.2.1 in: CVE-2025-48379: a write beyond the buffer"
    ]
