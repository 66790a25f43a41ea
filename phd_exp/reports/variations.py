"""The contribution of each part of a recipe: runs with other overrides compared with those without.

Both are compared on held-out images: images of the training split that were never trained on. Choices made by them
are independent of the test samples, which all other tables use.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from statistics import fmean

from phd_exp.evaluation.point_errors import ErrorKey
from phd_exp.records.choices import in_words
from phd_exp.reports.runs import Report, Run
from phd_exp.reports.table import NOTHING, Table, TableCell, TableRow, file_stem

DIGITS: Mapping[str, int] = {"nll": 2, "projected": 1, "depth": 0}  # columns and their decimals
OF_A_LINE = (
    "Held-out images: of the training split, never trained on, over the whole field of view. A number is the mean "
    "over seeds, in brackets the smallest and the largest. Errors: of the mode. Difference: of the NLL, or of a "
    "model without one of the depth error in per cent, to the run of the same seed without overrides; negative is "
    "better."
)
Variation = Mapping[int, Run]
"""Seed -> run, of runs that differ in their seed alone."""


def variation_tables(report: Report) -> list[Table]:
    """A table for every preset, data set and model with finished runs both with and without other overrides."""
    found: dict[tuple[str, str, str], dict[str | None, dict[int, Run]]] = {}
    for run in report.runs:
        if run.state == "finished" and run.seed is not None and run.held_out_errors:
            variations = found.setdefault((run.preset, run.data, run.model), {})
            variations.setdefault(run.overrides, {})[run.seed] = run
    return [
        _table(choice, variations)
        for choice, variations in found.items()
        if len(variations) > 1 and None in variations
    ]


def values(variation: Variation, quantity: str) -> dict[int, float]:
    """Seed -> `nll` (nats, only of a model with a density), `projected` or `depth` error (mm)."""
    if quantity == "nll":
        return {seed: run.held_out_nll for seed, run in variation.items() if run.held_out_nll is not None}
    key = ErrorKey("mode", "whole", quantity)  # type: ignore[arg-type]
    return {seed: run.held_out_errors[key].value for seed, run in variation.items()}


def _table(choice: tuple[str, str, str], found: Mapping[str | None, Variation]) -> Table:
    preset, data, model = choice
    plain = found[None]
    others = {overrides: runs for overrides, runs in found.items() if overrides is not None}
    best_first = sorted(others, key=lambda overrides: _order(others[overrides]))
    return Table(
        stem=file_stem("variations", preset, data, model),
        kind="variations",
        title=f"Variations of {in_words(preset)}: {model} on {data}, held-out images",
        stub=("overrides", "seeds"),
        columns=("NLL (nats)", "projected (mm)", "depth (mm)", "difference"),
        groups=(
            (_row("", plain, TableCell("")),),
            tuple(_row(name, others[name], _difference(others[name], plain)) for name in best_first),
        ),
        notes=(OF_A_LINE,),
        preset=preset,
    )


def _order(variation: Variation) -> float:
    return fmean((values(variation, "nll") or values(variation, "depth")).values())


def _row(overrides: str, variation: Variation, difference: TableCell) -> TableRow:
    cells = (_mean(overrides, variation, quantity) for quantity in DIGITS)
    return TableRow((overrides or "none", ", ".join(map(str, sorted(variation)))), (*cells, difference))


def _mean(overrides: str, variation: Variation, quantity: str) -> TableCell:
    found = values(variation, quantity)
    numbers = tuple(
        variation[seed].choice | {"overrides": overrides, "seed": seed, "quantity": quantity, "value": value}
        for seed, value in found.items()
    )
    return replace(_cell(found.values(), DIGITS[quantity]), numbers=numbers)


def _difference(variation: Variation, plain: Variation) -> TableCell:
    now, before = values(variation, "nll"), values(plain, "nll")
    if shared := now.keys() & before.keys():
        return _cell([now[seed] - before[seed] for seed in shared], 2, sign="+")
    now, before = values(variation, "depth"), values(plain, "depth")
    return _cell([100 * (now[seed] / before[seed] - 1) for seed in now.keys() & before.keys()], 0, sign="+")


def _cell(numbers: Iterable[float], digits: int, sign: str = "") -> TableCell:
    found = list(numbers)
    if not found:
        return TableCell(NOTHING)
    mean, least, largest = (f"{x:{sign}.{digits}f}" for x in (fmean(found), min(found), max(found)))
    return TableCell(mean, f"({least} to {largest})" if len(found) > 1 else "")
