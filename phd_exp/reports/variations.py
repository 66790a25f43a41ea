"""What each part of a recipe contributes: runs with other overrides beside those without, on held-out images.

Held-out images are of the training split and were never trained on. What is chosen by them is not chosen by the test
samples, which all other tables are about.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from phd_exp.evaluation.point_errors import ErrorKey
from phd_exp.records.choices import in_words
from phd_exp.records.errors import one_line
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem

AS_IT_IS = "none"
OF_A_LINE = (
    "Held-out images: of the training split, never trained on, over the whole field of view. A number is the mean "
    "over seeds, in brackets the smallest and the largest. Errors: of the mode. Difference: of the NLL, or of a "
    "model without one of the depth error in per cent, to the run of the same seed without overrides; negative is "
    "better."
)


@dataclass(frozen=True)
class Variation:
    """Runs that differ in their seed alone."""

    overrides: str | None
    seeds: Mapping[int, Run]

    def values(self, quantity: str) -> dict[int, float]:
        """Seed -> `nll` (nats, none of a model without a density), `projected` or `depth` error (mm)."""
        if quantity == "nll":
            return {
                seed: run.held_out_nll for seed, run in self.seeds.items() if run.held_out_nll is not None
            }
        key = ErrorKey("mode", "whole", quantity)  # type: ignore[arg-type]
        return {seed: run.held_out_errors[key].value for seed, run in self.seeds.items()}


def variation_tables(report: Report) -> list[Table]:
    """A table for every preset, data set and model of which there are runs with other overrides and without."""
    choices = dict.fromkeys((run.preset, run.data, run.model) for run in report.runs if run.overrides)
    found = ((choice, _variations(report, choice)) for choice in choices)
    return [
        _table(choice, variations)
        for choice, variations in found
        if len(variations) > 1 and variations[0].overrides is None
    ]


def _variations(report: Report, choice: tuple[str, str, str]) -> list[Variation]:
    """The runs without overrides, if there are any, and then the others, the best first."""
    found: dict[str | None, dict[int, Run]] = {}
    for run in report.runs:
        is_one = (run.preset, run.data, run.model) == choice and run.state == "finished"
        if is_one and run.seed is not None and run.held_out_errors:
            found.setdefault(run.overrides, {})[run.seed] = run
    variations = [Variation(overrides, seeds) for overrides, seeds in found.items()]
    return sorted(variations, key=lambda one: (one.overrides is not None, _order(one)))


def _order(variation: Variation) -> float:
    return fmean((variation.values("nll") or variation.values("depth")).values())


def _table(choice: tuple[str, str, str], variations: Sequence[Variation]) -> Table:
    preset, data, model = choice
    plain = variations[0]
    rows = [_row(one, plain) for one in variations]
    return Table(
        stem=file_stem("variations", preset, data, model),
        kind="variations",
        title=one_line(f"Variations of {in_words(preset)}: {model} on {data}, held-out images"),
        stub=("overrides", "seeds"),
        columns=("NLL (nats)", "projected (mm)", "depth (mm)", "difference"),
        groups=((rows[0],), tuple(rows[1:])),
        notes=(OF_A_LINE,),
        preset=preset,
        numbers=tuple(
            {"preset": preset, "data": data, "model": model, "overrides": one.overrides or "", "seed": seed}
            | {"quantity": quantity, "value": value}
            for one in variations
            for quantity in ("nll", "projected", "depth")
            for seed, value in one.values(quantity).items()
        ),
    )


def _row(variation: Variation, plain: Variation) -> TableRow:
    cells = [
        _cell(variation.values(quantity).values(), digits)
        for quantity, digits in (("nll", 2), ("projected", 1), ("depth", 0))
    ]
    seeds = ", ".join(map(str, sorted(variation.seeds)))
    difference = TableCell("") if variation is plain else _difference(variation, plain)
    return TableRow((one_line(variation.overrides or AS_IT_IS), seeds), (*cells, difference))


def _difference(variation: Variation, plain: Variation) -> TableCell:
    now, before = variation.values("nll"), plain.values("nll")
    if shared := now.keys() & before.keys():
        return _cell([now[seed] - before[seed] for seed in shared], 2, sign="+")
    now, before = variation.values("depth"), plain.values("depth")
    return _cell([100 * (now[seed] / before[seed] - 1) for seed in now.keys() & before.keys()], 0, sign="+")


def _cell(values: Iterable[float], digits: int, sign: str = "") -> TableCell:
    numbers = list(values)
    if not numbers:
        return TableCell(NOTHING)
    mean, least, largest = (f"{x:{sign}.{digits}f}" for x in (fmean(numbers), min(numbers), max(numbers)))
    return TableCell(mean, f"({least} to {largest})" if len(numbers) > 1 else "")
