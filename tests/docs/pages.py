"""The pages of the documentation, taken apart."""

import re
import runpy
import shlex
from pathlib import Path
from typing import NamedTuple

from phd_exp.cli import PACKAGE

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
REFERENCE = runpy.run_path(str(DOCS / ".build" / "reference.py"))["pages"]()
"""The pages that are made from docstrings, by their addresses."""
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:^ {4}.*\n)+", re.MULTILINE)


class Block(NamedTuple):
    """A fenced block: its language, its text, and the line of the page on which the text begins."""

    language: str
    text: str
    line: int

    @property
    def file(self) -> str | None:
        """The file that the block is, if its first line names one."""
        found = re.match(r"# ([\w/]+\.(?:py|yaml))\b", self.text)
        return found[1] if found else None


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    return [Block(found[1], found[2], text[: found.start(2)].count("\n") + 1) for found in _BLOCK.finditer(text)]


def commands(page: Path) -> list[list[str]]:
    """The words of every command of this programme in the `sh` blocks and the indented lines of a page."""
    fenced = [block.text for block in blocks(page) if block.language == "sh"]
    indented = _INDENTED.findall(_BLOCK.sub("", page.read_text()))
    lines = [
        line.partition(" #")[0].strip()
        for text in (*fenced, *indented)
        for line in text.replace("\\\n", " ").splitlines()
    ]
    return [shlex.split(line)[3:] for line in lines if line.split()[:3] == ["python", "-m", "phd_exp"]]


def module(file: Path) -> str:
    """A source file's dotted name."""
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def name(page: Path) -> str:
    """A page as mkdocs.yml names it."""
    return str(page.relative_to(DOCS))
