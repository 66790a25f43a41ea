"""The paper's seven constraints as a table: which of them each density satisfies, as measured."""

from collections.abc import Mapping

from phd_exp.distributions.constraints import SCALE, Finding
from phd_exp.reports.formats.markdown import escaped


def constraints_table(measured: Mapping[str, Mapping[str, Finding]]) -> str:
    """The table as GitHub's Markdown: a line per constraint, a column per model, a dash where nothing was measured.

    `constraints_table(findings())` with `phd_exp.distributions.constraints.findings` is the table of the heads.
    """
    models = list(dict.fromkeys(model for row in measured.values() for model in row))
    lines = [
        _joined(["constraint", *map(escaped, models)]),
        _joined(["---"] * (1 + len(models))),
        *(
            _joined([escaped(constraint), *(_cell(row.get(model)) for model in models)])
            for constraint, row in measured.items()
        ),
    ]
    return "\n".join(["## The seven constraints", "", *lines, "", *_notes()]) + "\n"


def _cell(finding: Finding | None) -> str:
    if finding is None:
        return "-"
    return f"{'holds' if finding.holds else '**breaks**'} ({finding.measured:.2g})"


def _notes() -> list[str]:
    return [
        f"- A baseline is the density exp(-|residual|/{SCALE:g}) in its own coordinates: minimising the mean norm of",
        "  residuals is maximum likelihood under it. The decomposed density is p(x/z, y/z) p(z)/z^2.",
        "- Columns are heads. A network with camera=shown breaks 2, whatever its head.",
        "- In brackets: 1 the factor by which wanted spreads are missed; 2 the relative change of log p with f;",
        "  3 the density behind the camera over that in front; 4 the share of positions ruled out; 5 nats above a",
        "  chord; 6 the least fall of log p over a factor of 1000 towards a limit, nats; 7 its largest jump, nats.",
    ]


def _joined(texts: list[str]) -> str:
    return f"| {' | '.join(texts)} |"
