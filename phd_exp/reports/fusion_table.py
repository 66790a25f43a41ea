"""What fusion gives, as a table in the manner of the paper's: a column a number of cameras, a line a method."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from phd_exp.evaluation.fusion import (
    CALIBRATION,
    ERRORS,
    LEVELS,
    METHODS,
    FusionScores,
    Method,
    Place,
    fusion_scores,
)
from phd_exp.evaluation.predictions import Band
from phd_exp.evaluation.several_views import read_views
from phd_exp.records.choices import in_words
from phd_exp.records.errors import RunError, one_line
from phd_exp.reports.cells import Gap
from phd_exp.reports.collect import Records, Run
from phd_exp.reports.tables import TableCell, TableRow

NAMES: dict[Method, str] = {
    "mode": "Huber, mode",
    "mean": "Huber, mean",
    "average": "average",
    "gaussian": "Gaussian",
}
QUANTITIES = {
    "depth_error_mm": "depth (mm)",
    "distance_mm": "distance (mm)",
    "coverage_50": "inside 50 %",
    "coverage_90": "inside 90 %",
    "coverage_99": "inside 99 %",
    "normalised_squared_error": "squared error",
}
ON_GROUND = ", ground"
STRONG = 0.5
"""A correlation from which on the one is said to move with the other."""
OF_A_LINE = (
    "Columns: how many cameras of each scene are fused, beginning with the first. Depth: the error along the first "
    "camera's true viewing ray, as in the paper's tables; distance: in space; both means over scenes. In brackets: "
    "95 % bootstrap intervals over scenes. Bold: the smallest of a group and column as printed."
)
OF_METHODS = (
    "Huber: the most likely position under the product of the views' Projected Huber densities, and the mean of that "
    "product. Average: of the views' modes. Gaussian: the views' means weighted by their inverse covariances."
)
OF_THE_GROUND = (
    "Ground: besides, every position is known to lie on a plane through the true one with the normal (0, cos 30°, "
    "sin 30°) in the first camera's frame, the ground before a camera that looks down by 30°; a level camera would "
    "see its ground edge-on. The average is moved to the nearest point of the plane, the Gaussian conditioned on it."
)


@dataclass(frozen=True)
class FusionTable:
    """The table of one run.

    Attributes:
        stem: of its file names.
        run: which one.
        scores: all its numbers.
        gaps: none; what the formats ask of any table, as is `command`.
    """

    stem: str
    title: str
    stub: tuple[str, ...]
    columns: tuple[str, ...]
    groups: tuple[tuple[TableRow, ...], ...]
    notes: tuple[str, ...]
    run: Run
    scores: FusionScores
    gaps: tuple[Gap, ...] = ()
    command: str = ""

    @property
    def caption(self) -> str:
        """The title, which is a sentence of its own."""
        return self.title


def fusion_tables(records: Records) -> tuple[list[FusionTable], list[str]]:
    """The tables of all runs that recorded several views, and a line for each record that cannot be used."""
    tables, complaints = [], []
    for run in records.runs:
        if not run.folder.views.exists():
            continue
        try:
            tables.append(fusion_table(run, fusion_scores(read_views(run.folder.views))))
        except RunError as error:
            complaints.append(one_line(f"{run.folder.path}/{error}"))
    return tables, complaints


def fusion_table(run: Run, scores: FusionScores) -> FusionTable:
    """The table of a run's scores."""
    leaf = run.folder.path.name
    apart = "" if (run.data, run.model) == ("scale", "probabilistic") else f"{run.model} on {run.data}, "
    title = f"Fusion, {in_words(run.preset)}, {apart}{leaf}: {scores.n} scenes seen by {scores.views} cameras"
    return FusionTable(
        stem=f"fusion-{run.preset}-{run.data}-{run.model}-{leaf}",
        title=one_line(title),
        stub=("quantity", "method"),
        columns=tuple(f"{k} camera{'s' if k > 1 else ''}" for k in _cameras(scores)),
        groups=tuple(_groups(scores)),
        notes=(OF_A_LINE, OF_METHODS, OF_THE_GROUND, *_measured(scores)),
        run=run,
        scores=scores,
    )


def _cameras(scores: FusionScores) -> range:
    return range(1, scores.views + 1)


def _groups(scores: FusionScores) -> Iterator[tuple[TableRow, ...]]:
    for on_plane in (False, True):
        for quantity in ERRORS:
            yield tuple(_rows(scores, quantity, on_plane, bold=True))
    for on_plane in (False, True):
        yield tuple(row for name in CALIBRATION for row in _rows(scores, name, on_plane, bold=False))


def _rows(scores: FusionScores, quantity: str, on_plane: bool, bold: bool) -> Iterator[TableRow]:
    lines = {
        method: [scores.bands[Place(quantity, method, k, on_plane)] for k in _cameras(scores)]
        for method in METHODS
        if Place(quantity, method, 1, on_plane) in scores.bands
    }
    columns = zip(*lines.values(), strict=True)
    best = [_number(quantity, min(band.value for band in column)) if bold else "" for column in columns]
    label = QUANTITIES[quantity] + (ON_GROUND if on_plane else "")
    for method, line in lines.items():
        name = NAMES[method] if bold else NAMES[method].removesuffix(", mean")
        cells = (_cell(quantity, band, least) for band, least in zip(line, best, strict=True))
        yield TableRow((label, name), tuple(cells))


def _cell(quantity: str, band: Band, best: str) -> TableCell:
    value, low, high = (_number(quantity, number) for number in (band.value, band.low, band.high))
    return TableCell(value, f"({low}–{high})", bold=value == best)


def _number(quantity: str, value: float) -> str:
    if quantity in ERRORS:
        return f"{value:.0f}" if value >= 100 else f"{value:.1f}"
    return f"{value:.2f}" if quantity == "normalised_squared_error" else f"{value:.0f}"


def _measured(scores: FusionScores) -> list[str]:
    covered = ", ".join(f"{share:.0f}" for share in scores.calibrated_coverage)
    levels = ", ".join(map(str, LEVELS))
    said = [
        f"Inside {levels} %: per cent of true positions in the ellipsoids of mean and covariance that hold so much "
        f"of a Gaussian; the densities have longer tails, and of one camera {covered} would be inside if they were "
        "exact. Squared error: the squared Mahalanobis distance per dimension, 1 on average where calibrated, above "
        "1 where overconfident."
    ]
    said.append(_common_cause(scores))
    if scores.left_out:
        said.append(
            f"{scores.left_out} further scenes are left out: a prediction was not finite, or no position is in front "
            "of every camera."
        )
    return said


def _common_cause(scores: FusionScores) -> str:
    views, size = scores.correlation, scores.with_size
    said = (
        f"Fusion takes the views' errors for independent. Those of log depth of two views of a scene have the "
        f"correlation {views.value:.2f} ({views.low:.2f}–{views.high:.2f})"
    )
    if math.isfinite(size.value):
        said += f", and their average has {size.value:.2f} with log size"
        if abs(size.value) > STRONG:
            said += ": the size of an object, common to its views, shifts all of them"
    last = scores.bands[Place("normalised_squared_error", "mean", scores.views, False)]
    if last.low > 1:
        said += f"; the fused squared error of {last.value:.2f} says that they are overconfident together"
    elif last.high < 1:
        said += f"; the fused squared error of {last.value:.2f} says that they are underconfident together"
    else:
        said += f"; the fused squared error of {last.value:.2f} does not differ from 1 by more than chance"
    return said + "."


def headline(scores: FusionScores) -> str:
    """The depth error of one camera and of all, in words."""
    one, all_ = (scores.bands[Place("depth_error_mm", "mode", k, False)] for k in (1, scores.views))
    return (
        f"depth error {_number('depth_error_mm', one.value)} mm with one camera, "
        f"{_number('depth_error_mm', all_.value)} mm with {scores.views}"
    )
