"""Formulas between dollar signs as MathML, which browsers draw: the pages need no script and no network."""

import re
from typing import Any
from xml.etree.ElementTree import fromstring

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.inlinepatterns import InlineProcessor


class _Formula(InlineProcessor):
    """`$x$` within a line, `$$x$$` as a paragraph."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[Any, int, int]:  # type: ignore[override]
        display = "block" if m[1] == "$$" else "inline"
        mathml = convert(m[2].strip(), display=display).replace('xmlns="http://www.w3.org/1998/Math/MathML" ', "")
        return fromstring(mathml), m.start(), m.end()


class Formulas(Extension):
    """Adds the pattern before Markdown looks for emphasis."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the pattern."""
        md.inlinePatterns.register(_Formula(r"(?<![\\$])(\$\$?)(?!\s)([^$]+?)\1(?!\$)", md), "formula", 185)


def on_config(config: Any) -> Any:
    """Called by MkDocs."""
    config.markdown_extensions.append(Formulas())
    return config
