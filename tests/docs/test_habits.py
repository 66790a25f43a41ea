"""What contributors are told is what is checked."""

import re
import tomllib
from typing import Any

import yaml
from pre_commit.clientlib import load_config

from tests.docs.pages import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()


def test_hooks_are_local_and_those_of_make_lint() -> None:
    file = ROOT / ".pre-commit-config.yaml"
    load_config(file)  # raises for what pre-commit would refuse
    (repository,) = yaml.safe_load(file.read_text())["repos"]
    assert repository["repo"] == "local"
    assert all(hook["language"] == "system" for hook in repository["hooks"])
    lint = (ROOT / "Makefile").read_text().partition("\nlint:")[2].partition("\n\n")[0]
    tools = {words.split()[0] for words in re.findall(r"\$\(BIN\)/(.*)", lint)} - {"python"}
    assert {hook["entry"].split()[0] for hook in repository["hooks"]} == tools


def test_the_floors_are_those_that_are_checked() -> None:
    layers = next(c for c in PROJECT["tool"]["importlinter"]["contracts"] if c["type"] == "layers")["layers"]
    checked = [_names(layer.replace("phd_exp.", "")) for layer in layers if "__main__" not in layer]
    block = CONTRIBUTING.partition("## Floors")[2].partition("## ")[0]
    drawn = [_names(re.split(r" {2,}", line.strip())[0]) for line in block.splitlines() if line[:4] == "    "]
    assert drawn == checked


def test_files_that_contributors_are_sent_to_are_there_and_all_examples_are_named() -> None:
    paths = {
        path for path in re.findall(r"`([\w.-]+/[\w./-]*[\w/])`", CONTRIBUTING) if not re.search("NAME|VERB", path)
    }
    missing = [path for path in paths if not any((place / path).exists() for place in (ROOT, ROOT / "phd_exp"))]
    assert paths
    assert [path for path in missing if not path.isupper()] == []
    examples = (ROOT / "tests" / "extending").glob("test_*.py")
    assert [file.name for file in examples if f"tests/extending/{file.name}" not in CONTRIBUTING] == []


def test_changelog_and_citation_have_the_version() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert any(heading.startswith(f"{PROJECT['project']['version']} ") for heading in headings)
    assert f"version = {{{PROJECT['project']['version']}}}" in (ROOT / "README.md").read_text()


def _names(layer: Any) -> set[str]:
    return {name.strip() for name in layer.split("|")}


def test_every_folder_keeps_its_budget() -> None:
    table = CONTRIBUTING.partition("## Budgets")[2].partition("## ")[0]
    rows = re.findall(r"^\| ([a-z, ]+) \| ([\d,]+) \| [\d,]+ \|$", table, re.MULTILINE)
    limits = {names: int(limit.replace(",", "")) for names, limit in rows}
    rooms = {room for names in limits for room in names.split(", ")}
    assert rooms == {file.parent.name for file in (ROOT / "phd_exp").glob("*/__init__.py")} | {"top", "tests"}
    for names, limit in limits.items():
        lines = sum(map(_lines, names.split(", ")))
        assert lines <= limit, f"{names}: {lines} lines; the budget in CONTRIBUTING.md is {limit}"


def _lines(room: str) -> int:
    folder = ROOT / room if room == "tests" else ROOT / "phd_exp" / room
    files = (ROOT / "phd_exp").glob("*.py") if room == "top" else folder.rglob("*.py")
    return sum(len(file.read_text().splitlines()) for file in files)
