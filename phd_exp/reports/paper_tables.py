"""The paper's two tables in both readings, for every preset with any of their runs."""

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, product
from typing import Any

import pandas as pd

from phd_exp.evaluation.point_errors import COLUMNS, READINGS, Estimate, Quantity, Reading, paired
from phd_exp.records.choices import PLAIN_RECIPE, in_words, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.reports.numbers import over_seeds
from phd_exp.reports.paper import ASSUMED, BELOW_BOUND, LAYOUTS, OF_A_BOUND, PUBLISHED, Layout, TableName, bound_mm
from phd_exp.reports.quantities import NOTHING
from phd_exp.reports.report import Report
from phd_exp.reports.runs import PROBABILISTIC
from phd_exp.reports.table import Table, TableCell, TableRow, file_stem

DIGITS: dict[Quantity, int] = {"projected": 1, "depth": 0}  # decimals of a millimetre, as in the paper
OTHERS: tuple[Estimate, ...] = ("mean", "median", "eight views")  # of the density; the paper reports its mode alone
ONE_SEED = "†"
FEWER_SEEDS = "‡"
IN_WORDS: dict[Reading, str] = {
    "whole": "the whole field of view",
    "central": "the central half of the field of view",
}
OF_THE_READING: dict[Reading, str] = {
    "whole": "Test samples: all, over the whole field of view, as in the paper's text.",
    "central": "Test samples: those in the central half of the field of view, |v_p| ≤ 1/2 in both coordinates, where "
    "the authors' generator places all objects. The networks were trained on the whole field of view.",
}
OF_A_CELL = (
    "A cell: our mean error in mm; below it the paper's figure and (× ours / paper). Bold: smaller than every other "
    "model of its column by a 95 % paired t-test over seeds; never one seed."
)
OF_THE_SPLITS = "Held-out training samples chose the recipe and fitted the temperatures. Test samples chose nothing."
OF_AN_INTERVAL = {
    "seeds_and_samples": "±: 95 % interval of the mean, over seeds (Student's t) and test samples.",
    "samples": f"±{ONE_SEED}: one seed; 1.96 standard errors over its test samples. It does not say how another "
    "training would differ.",
    "none": "No ±: one seed, one test sample.",
}
OF_FEWER_SEEDS = f"{FEWER_SEEDS}: fewer seeds than other cells of this table."
CSV = (
    *("preset", "table", "data", "model", "estimate", "reading", "quantity", "n_seeds", "mean", "low", "high"),
    *("interval", "published", "ratio", "bound", "best", "n_test", "state"),
)  # fmt: skip
Cell = dict[str, Any]
"""A number of a table: the columns of `CSV`; `values` and `images` of its seeds; `gaps`, why a seed is missing."""


def paper_tables(report: Report) -> list[Table]:
    """Both tables in both readings, for every preset that has any of a table's runs."""
    facts = report.facts
    plain = facts[facts["seed"].notna() & (facts["words"] == "")]
    errors = [f"{quantity}_error_mm" for quantity in DIGITS]
    known = report.select(split="test", quantity=errors, method=[*COLUMNS, "eight views"])
    known = known[known["seed"].notna() & (known["words"] == "")]
    tables = []
    for preset in report.presets:
        for layout in LAYOUTS:
            begun = plain[plain["data"].isin(layout.data) & plain["model"].isin(layout.models)]
            begun = begun[begun["preset"] == preset]
            own = known[known["path"].isin(begun["path"])]
            tables += [_table(report, preset, layout, begun, own, reading) for reading in READINGS if len(begun)]
    return tables


def _table(
    report: Report, preset: str, layout: Layout, begun: pd.DataFrame, known: pd.DataFrame, reading: Reading
) -> Table:
    """The table of a layout, reduced to the data sets and models with a run."""
    data = [name for name in layout.data if name in set(begun["data"])]
    models = [name for name in layout.models if name in set(begun["model"])]
    is_by_line = len(layout.data) > 1  # whether each error has a line
    cells = _cells(layout.name, begun, known, reading)

    def rows(model: str, estimate: str) -> list[list[Cell]]:
        each = [[cells[name, model, estimate, quantity] for name in data] for quantity in DIGITS]
        return each if is_by_line else [[*chain(*each)]]

    groups = [[row for line in group for row in rows(*line)] for group in _groups(models, known)]
    shown = [cell for group in groups for row in group for cell in row]
    _find_best([*chain(*groups[0])])
    gaps = dict.fromkeys((reason, one["model"], one["data"], n) for one in shown for n, reason in one["gaps"].items())
    can_be_made = any(not reason.startswith("no sample") for reason, *_ in gaps)
    left_out = ", ".join(name for name in (*layout.data, *layout.models) if name not in (*data, *models))
    return Table(
        stem=file_stem(layout.name, preset, reading),
        kind="tables",
        title=f"The paper's {layout.title}, {in_words(preset)}: {IN_WORDS[reading]}{_samples(shown)}",
        stub=("model", "error (mm)") if is_by_line else ("model",),
        columns=tuple(data if is_by_line else (f"{quantity} error (mm)" for quantity in DIGITS)),
        groups=(
            *(tuple(_row(row, is_by_line) for row in group) for group in groups),
            tuple(_bound_rows(layout, data, is_by_line)),
        ),
        notes=_notes(layout, reading, shown, left_out),
        below="paper (ratio)",
        gaps=tuple(gap_lines(gaps)),
        command=making_command(report, preset, layout.name, sorted(set(begun["seed"]))) if can_be_made else "",
        preset=preset,
        reading=reading,
        lines=pd.DataFrame([{name: cell[name] for name in CSV} for cell in shown], dtype=object),
    )


def _groups(models: Sequence[str], known: pd.DataFrame) -> Iterator[list[tuple[str, str]]]:
    """The paper's lines, then the density's other estimates; eight views only if a run has recorded them."""
    yield [(model, "mode") for model in models]
    recorded = {*COLUMNS, *known["method"]}
    if PROBABILISTIC in models:
        yield [(PROBABILISTIC, estimate) for estimate in OTHERS if estimate in recorded]


def _cells(
    table: TableName, begun: pd.DataFrame, known: pd.DataFrame, reading: Reading
) -> dict[tuple[str, str, str, Quantity], Cell]:
    """(data set, model, estimate, quantity) -> number, of all that a preset may have."""
    keys = ["data", "model", "method", "quantity"]
    known = known[known["subject"] == reading]
    means = {(row.data, row.model, row.method, row.quantity): row for row in over_seeds(known).itertuples()}
    tested = dict(iter(known.groupby(keys, sort=False)))
    runs = {place: {int(one.seed): one for one in part.itertuples()} for place, part in begun.groupby(keys[:2])}
    seeds = sorted({int(seed) for seed in begun["seed"]})
    found: dict[tuple[str, str, str, Quantity], Cell] = {}
    places = product(begun["data"].unique(), begun["model"].unique(), (*COLUMNS, "eight views"), DIGITS)
    for data, model, estimate, quantity in places:
        key = data, model, estimate, f"{quantity}_error_mm"
        started, part, mean = runs.get((data, model), {}), tested.get(key, known[:0]), means.get(key)
        values = {int(seed): value for seed, value in zip(part["seed"], part["value"], strict=True)}
        gaps = {seed: _reason(started.get(seed), estimate) for seed in seeds if started and seed not in values}
        published = PUBLISHED.get((model, data), {}).get(quantity) if estimate == "mode" else None
        low, high = (None, None) if mean is None or pd.isna(mean.low) else (mean.low, mean.high)
        scatter = "none" if low is None else "seeds_and_samples" if len(values) > 1 else "samples"
        found[data, model, estimate, quantity] = {
            "preset": begun["preset"].iloc[0], "table": table, "data": data, "model": model, "estimate": estimate,
            "reading": reading, "quantity": key[-1], "n_seeds": len(values), "mean": mean.value if mean else None,
            "low": low, "high": high, "interval": scatter,
            "published": published, "ratio": mean.value / published if mean and published else None,
            "bound": bound_mm(model, data, quantity, "shown" in set(part["camera"])), "best": False,
            "n_test": int(mean.n) if mean else 0, "state": _state(values, gaps), "values": values, "gaps": gaps,
            "images": set(part["images"]), "counts": set(part["n"]),
        }  # fmt: skip
    return found


def _state(values: Mapping[int, float], gaps: Mapping[int, str]) -> str:
    """`finished`, the reason for a missing number, or the number of finished seeds."""
    if values and gaps:
        return f"{len(values)} of {len(values) + len(gaps)} seeds"
    return "finished" if values else next(iter(gaps.values()), NOTHING).partition(":")[0]


def _reason(run: Any, estimate: str) -> str:
    """Why a run has no error: a state, and details."""
    if run is None:
        return "missing"
    if run.state == "finished" and estimate == "eight views":
        return "no eight views: repeat its command with evaluation.eight_views=true"
    if run.state == "finished":
        return "no sample: none of its test samples lies in the central half"
    return f"{run.state}: {run.detail}" if run.detail else run.state


def _find_best(cells: Sequence[Cell]) -> None:
    """Mark the cells that are significantly smaller than every other of their data set and error."""
    for cell in cells:
        column = [one for one in cells if (one["data"], one["quantity"]) == (cell["data"], cell["quantity"])]
        others = [one for one in column if one["values"] and one is not cell]
        cell["best"] = bool(others and cell["values"]) and all(
            len(cell["images"] | one["images"]) == 1 and paired(cell["values"], one["values"])[0].high < 0
            for one in others
        )


def _row(cells: Sequence[Cell], is_by_line: bool) -> TableRow:
    model, quantity = cells[0]["model"], cells[0]["quantity"].removesuffix("_error_mm")
    label = f"{model} ({cells[0]['estimate']})" if model == PROBABILISTIC else model
    return TableRow((label, quantity) if is_by_line else (label,), tuple(map(_table_cell, cells)))


def _table_cell(cell: Cell) -> TableCell:
    digits = DIGITS[cell["quantity"].removesuffix("_error_mm")]
    paper = "" if cell["published"] is None else f"{cell['published']:.{digits}f}"
    if cell["mean"] is None:
        return TableCell(cell["state"], below=paper)
    paper += "" if cell["ratio"] is None else f" (×{cell['ratio']:.2f})"
    marks = {ONE_SEED: cell["interval"] == "samples", BELOW_BOUND: _is_below(cell), FEWER_SEEDS: bool(cell["gaps"])}
    spread = "" if cell["low"] is None else f"±{(cell['high'] - cell['low']) / 2:.{digits}f}"
    spread += "".join(mark for mark, holds in marks.items() if holds)
    return TableCell(f"{cell['mean']:.{digits}f}", spread, paper, cell["best"])


def _is_below(cell: Cell) -> bool:
    """Whether the mean is smaller than its bound, by chance or because more is known than the bound assumes."""
    return cell["mean"] is not None and cell["bound"] is not None and cell["mean"] < cell["bound"]


def _bound_rows(layout: Layout, data: Sequence[str], is_by_line: bool) -> Iterator[TableRow]:
    """The rows of bounds on depth error that a column has."""
    for label, bounds in layout.bounds.items():
        known = [*([] if is_by_line else [None]), *map(bounds.get, data)]
        if any(known):
            cells = (TableCell(f"{bound:.0f}" if bound else NOTHING) for bound in known)
            yield TableRow((label, "depth") if is_by_line else (label,), tuple(cells))


def _notes(layout: Layout, reading: Reading, cells: Sequence[Cell], left_out: str) -> tuple[str, ...]:
    """The notes that explain the contents of a table."""
    measured = [cell for cell in cells if cell["values"]]
    kinds = {cell["interval"] for cell in measured}
    notes = {OF_THE_READING[reading]: True, OF_A_CELL: True}
    notes |= {text: kind in kinds for kind, text in OF_AN_INTERVAL.items()}
    notes[OF_FEWER_SEEDS] = any(cell["gaps"] for cell in measured)
    notes[OF_A_BOUND] = any(map(_is_below, measured))
    notes |= {ASSUMED: True, layout.note: True, OF_THE_SPLITS: True}
    notes[f"Left out of {layout.title}, without a run: {left_out}."] = bool(left_out)
    return tuple(text for text, applies in notes.items() if applies)


def _samples(cells: Sequence[Cell]) -> str:
    """The number of test samples; a range if runs were tested on different numbers of them."""
    counts = sorted({int(n) for cell in cells for n in cell["counts"]})
    return f", {' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))} test samples" if counts else ""


def gap_lines(gaps: Iterable[tuple[str, str, str, int]]) -> list[str]:
    """The missing runs (reason, model, data set, seed) in words: a line for each reason, model and list of seeds."""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for reason, model, data, seed in gaps:
        seeds.setdefault((reason, model, data), []).append(seed)
    lines: dict[tuple[str, str, str], list[str]] = {}
    for (reason, model, data_set), found in seeds.items():
        numbers = f"seed{'s' if len(found) > 1 else ''} {', '.join(map(str, found))}"
        lines.setdefault((reason, model, numbers), []).append(data_set)
    return [f"{model} on {', '.join(data)} ({numbers}): {reason}" for (reason, model, numbers), data in lines.items()]


def making_command(report: Report, preset: str, name: TableName, seeds: Iterable[int] = (0,)) -> str:
    """The command line that makes the missing runs of a table."""
    preset, recipe = preset_and_recipe(preset)
    words = [f"experiment={name}", f"preset={preset}"]
    if recipe != PLAIN_RECIPE:
        words.append(f"recipe={recipe}")
    if list(seeds) != [0]:
        words.append(f"seed={','.join(map(str, seeds))}")
    if report.folder.as_posix() != "runs":
        words.append(f"runs={report.folder}")
    return one_line(shlex.join(["python", "-m", "phd_exp", "-m", *words]))
