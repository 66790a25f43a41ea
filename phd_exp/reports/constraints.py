"""The paper's seven constraints as a table: which of them each model's density keeps, measured and not quoted."""

from collections.abc import Mapping

from phd_exp.distributions.constraints import SCALE, Finding
from phd_exp.reports.formats.markdown import escaped


def constraints_table(measured: Mapping[str, Mapping[str, Finding]]) -> str:
    """The table as GitHub's Markdown: a line a constraint, a column a model, in each place what was measured.

    `constraints_table(findings())` with `phd_exp.distributions.constraints.findings` is the table of this project.
    """
    models = list(next(iter(measured.values())))
    lines = [
        _joined(["constraint", *map(escaped, models)]),
        _joined(["---"] * (1 + len(models))),
        *(
            _joined([escaped(constraint), *(_cell(row[model]) for model in models)])
            for constraint, row in measured.items()
        ),
    ]
    return "\n".join(["## The seven constraints", "", *lines, "", *_notes()]) + "\n"


def _cell(finding: Finding) -> str:
    return f"{'holds' if finding.holds else '**breaks**'} ({finding.measured:.2g})"


def _notes() -> list[str]:
    return [
        f"- A baseline is read as the density exp(-|residual|/{SCALE:g}) in its own coordinates: minimising the mean",
        "  norm of residuals is maximum likelihood under it.",
        "- In brackets: 1 the factor by which wanted spreads are missed; 2 the relative change of log p with f;",
        "  3 the density behind the camera over that in front; 4 the share of positions ruled out; 5 nats above a",
        "  chord; 6 the least fall of log p over a factor of 1000 towards a limit, nats; 7 its largest jump, nats.",
    ]


def _joined(texts: list[str]) -> str:
    return f"| {' | '.join(texts)} |"
