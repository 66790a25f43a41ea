"""What each part of a recipe contributes: runs with other overrides beside those without, on held-out images.

Held-out images are of the training split and were never trained on. What is chosen by them is not chosen by the test
samples, which all other tables are about.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from phd_exp.evaluation.point_errors import ErrorKey, mean_errors, mean_nll
from phd_exp.records.choices import in_words
from phd_exp.records.errors import RunError, one_line
from phd_exp.reports.cells import Gap
from phd_exp.reports.collect import Records, Run
from phd_exp.reports.tables import NOTHING, TableCell, TableRow

AS_IT_IS = "as it is"
OF_A_LINE = (
    "Held-out images: of the training split, never trained on, over the whole field of view. A number is the mean "
    "over seeds, in brackets the least and the largest. Errors: of the mode. Difference: of the NLL, or of a model "
    "without one of the depth error in per cent, to the run of the same seed as it is; positive where that is better."
)


@dataclass(frozen=True)
class HeldOut:
    """What a run reaches on its held-out images: nats (None of a model without a density), and millimetres."""

    nll: float | None
    projected: float
    depth: float


@dataclass(frozen=True)
class Variation:
    """Runs that differ in their seed alone."""

    overrides: str | None
    seeds: Mapping[int, HeldOut]


@dataclass(frozen=True)
class VariationTable:
    """The table of a preset with its recipe, a data set and a model; see `phd_exp.reports.tables.Table`."""

    stem: str
    title: str
    preset: str
    columns: tuple[str, ...]
    groups: tuple[tuple[TableRow, ...], ...]
    notes: tuple[str, ...] = (OF_A_LINE,)
    stub: tuple[str, ...] = ("overrides", "seeds")
    gaps: tuple[Gap, ...] = ()
    command: str = ""

    @property
    def caption(self) -> str:
        """The title, which is a sentence of its own."""
        return self.title


def variation_tables(records: Records) -> list[VariationTable]:
    """A table for every preset, data set and model of which there are runs with other overrides and without."""
    choices = dict.fromkeys((run.preset, run.data, run.model) for run in records.runs if run.overrides)
    found = ((choice, list(_variations(records, choice))) for choice in choices)
    return [
        _table(choice, variations)
        for choice, variations in found
        if len(variations) > 1 and variations[0].overrides is None
    ]


def _variations(records: Records, choice: tuple[str, str, str]) -> Iterator[Variation]:
    """The runs as they are, if there are any, and then the others, the best first."""
    runs = [run for run in records.runs if (run.preset, run.data, run.model) == choice]
    found: dict[str | None, dict[int, HeldOut]] = {}
    for run in runs:
        if run.seed is not None and (reached := _reached(run)) is not None:
            found.setdefault(run.overrides, {})[run.seed] = reached
    variations = [Variation(overrides, seeds) for overrides, seeds in found.items()]
    yield from sorted(variations, key=lambda one: (one.overrides is not None, _order(one)))


def _reached(run: Run) -> HeldOut | None:
    """None of a run that is not finished, or that recorded no held-out images that can be read."""
    if run.state != "finished":
        return None
    try:
        errors = mean_errors(run.folder.held_out, ["mode"])
    except RunError:
        return None
    projected, depth = (errors[ErrorKey("mode", "whole", name)].value for name in ("projected", "depth"))
    return HeldOut(mean_nll(run.folder.held_out), projected, depth)


def _order(variation: Variation) -> float:
    reached = variation.seeds.values()
    return fmean(one.depth if one.nll is None else one.nll for one in reached)


def _table(choice: tuple[str, str, str], variations: Sequence[Variation]) -> VariationTable:
    preset, data, model = choice
    plain = variations[0]
    return VariationTable(
        stem=f"variations-{preset}-{data}-{model}",
        title=one_line(f"Variations of {in_words(preset)}: {model} on {data}, held-out images"),
        preset=preset,
        columns=("NLL (nats)", "projected (mm)", "depth (mm)", "difference"),
        groups=((_row(plain, plain),), tuple(_row(one, plain) for one in variations[1:])),
    )


def _row(variation: Variation, plain: Variation) -> TableRow:
    reached = list(variation.seeds.values())
    nll = [one.nll for one in reached if one.nll is not None]
    cells = (
        _cell(nll, 2),
        _cell([one.projected for one in reached], 1),
        _cell([one.depth for one in reached], 0),
        TableCell("") if variation is plain else _difference(variation, plain),
    )
    seeds = ", ".join(map(str, sorted(variation.seeds)))
    return TableRow((one_line(variation.overrides or AS_IT_IS), seeds), cells)


def _difference(variation: Variation, plain: Variation) -> TableCell:
    pairs = [
        (variation.seeds[seed], plain.seeds[seed]) for seed in variation.seeds.keys() & plain.seeds.keys()
    ]
    nll = [now.nll - before.nll for now, before in pairs if now.nll is not None and before.nll is not None]
    if nll:
        return _cell(nll, 2, sign="+")
    return _cell([100 * (now.depth / before.depth - 1) for now, before in pairs], 0, sign="+")


def _cell(values: Sequence[float], digits: int, sign: str = "") -> TableCell:
    if not values:
        return TableCell(NOTHING)
    mean, least, largest = (
        f"{value:{sign}.{digits}f}" for value in (fmean(values), min(values), max(values))
    )
    return TableCell(mean, f"({least} to {largest})" if len(values) > 1 else "")
