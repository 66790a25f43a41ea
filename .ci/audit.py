"""Known bad releases among the requirements, offline: `[tool.phd_exp.known-bad]` against pins and floors.

Says what is wrong, a line each, and exits 1. No network is asked, so that nothing newer than the list is known.
"""

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]


def problems(project: dict[str, Any], constraints: str) -> Iterator[str]:
    """What is wrong with the requirements of a pyproject and the pins of a constraints.txt."""
    pins, asked = dict(_pins(constraints)), _asked(project["project"])
    for name, specifier in asked.items():
        if name in pins and pins[name] not in specifier:
            yield f"constraints.txt: {name}=={pins[name]} is not {specifier}, as pyproject.toml asks"
    for name, entry in project["tool"]["phd_exp"]["known-bad"].items():
        if name in pins and any(pins[name] in SpecifierSet(release) for release in entry["releases"]):
            yield f"constraints.txt: {name}=={pins[name]} is known to be bad: {entry['because']}"
        for last in map(Version, entry["last"]):
            if name in asked and last in asked[name]:
                yield f"pyproject.toml: {name}{asked[name]} lets {last} in: {entry['because']}"


def _asked(project: dict[str, Any]) -> dict[str, SpecifierSet]:
    """Name -> all that is asked of it, by whichever extra."""
    asked: dict[str, SpecifierSet] = {}
    for requirement in map(Requirement, _requirements(project)):
        name = canonicalize_name(requirement.name)
        asked[name] = asked.get(name, SpecifierSet()) & requirement.specifier
    return asked


def _requirements(project: dict[str, Any]) -> list[str]:
    extras = project["optional-dependencies"]
    return [*project["dependencies"], *(text for extra in extras if extra != "ray" for text in extras[extra])]


def _pins(constraints: str) -> Iterator[tuple[str, Version]]:
    for line in constraints.splitlines():
        name, _, version = line.partition("==")
        yield canonicalize_name(name), Version(version)


if __name__ == "__main__":
    found = list(
        problems(tomllib.loads((ROOT / "pyproject.toml").read_text()), (ROOT / "constraints.txt").read_text())
    )
    print("\n".join(found), end="\n" if found else "")
    sys.exit(bool(found))
