"""What is said above and below a table, in every format."""

import shlex
from collections.abc import Iterable, Sequence

from phd_exp.evaluation.point_errors import Reading
from phd_exp.records.choices import PLAIN_RECIPE, in_words, preset_and_recipe
from phd_exp.records.errors import one_line
from phd_exp.reports.cells import Cell, Gap
from phd_exp.reports.collect import Records
from phd_exp.reports.paper import ASSUMED, Layout, TableName

ONE_SEED = "†"
FEWER_SEEDS = "‡"
DEFAULT_RUNS = "runs"

IN_WORDS: dict[Reading, str] = {
    "whole": "the whole field of view",
    "central": "the central half of the field of view",
}
OF_THE_READING: dict[Reading, str] = {
    "whole": "Test samples: all, over the whole field of view, as the paper's text draws them.",
    "central": "Test samples: those in the central half of the field of view, |v_p| ≤ 1/2 in both coordinates, where "
    "the authors' generator places all its objects. The networks were trained on the whole.",
}
OF_A_CELL = (
    "A cell: ours, the mean error in mm; below it the paper's figure and (× ours / paper). Bold: the smallest of "
    "ours on that data set and error; figures that print alike share it, and one model alone gets none."
)
OF_AN_INTERVAL = {
    "student_t_over_seeds": "±: 95 % interval of the mean over seeds, Student's t.",
    "normal_over_samples": f"±{ONE_SEED}: one seed; 1.96 standard errors over its test samples, which says nothing "
    "of how another training would differ.",
    "none": "No ±: one seed, one test sample.",
}
OF_FEWER_SEEDS = f"{FEWER_SEEDS}: fewer seeds than other cells of this table have."


def title(preset: str, layout: Layout, reading: Reading, cells: Sequence[Cell]) -> str:
    """What a table is headed by."""
    return f"{layout.title}, {one_line(in_words(preset))}: {IN_WORDS[reading]}{_samples(cells)}"


def notes(layout: Layout, reading: Reading, cells: Sequence[Cell]) -> tuple[str, ...]:
    """How to read a table: of what its cells hold, and of nothing else."""
    kinds = {cell.interval.kind for cell in cells if cell.interval}
    said = [OF_THE_READING[reading], OF_A_CELL]
    said += [text for kind, text in OF_AN_INTERVAL.items() if kind in kinds]
    if any(cell.interval and cell.gaps for cell in cells):
        said.append(OF_FEWER_SEEDS)
    return (*said, ASSUMED, layout.note)


def _samples(cells: Sequence[Cell]) -> str:
    """How many test samples count; a range where runs were tested on different numbers of them."""
    counts = sorted({n for cell in cells for n in cell.n_test})
    if not counts:
        return ""
    return f", {counts[0]} to {counts[-1]} test samples" if len(counts) > 1 else f", {counts[0]} test samples"


def gap_lines(gaps: Iterable[Gap]) -> list[str]:
    """A line for each reason and model: which runs a table lacks."""
    lacking: dict[tuple[str, str, str], list[str]] = {}
    for (reason, model, data), seeds in _seeds_by_reason(gaps).items():
        numbers = f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
        lacking.setdefault((reason, model, numbers), []).append(data)
    return [
        f"{model} on {', '.join(data)} ({numbers}): {reason}"
        for (reason, model, numbers), data in lacking.items()
    ]


def _seeds_by_reason(gaps: Iterable[Gap]) -> dict[tuple[str, str, str], list[int]]:
    """(reason, model, data set) -> seeds."""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for gap in gaps:
        reason = f"{gap.state}: {one_line(gap.detail)}" if gap.detail else gap.state
        seeds.setdefault((reason, gap.model, gap.data), []).append(gap.seed)
    return seeds


def making_command(records: Records, preset: str, name: TableName, seeds: Iterable[int] = (0,)) -> str:
    """The command line that makes whatever a table lacks."""
    preset, recipe = preset_and_recipe(preset)
    words = [f"experiment={name}", f"preset={preset}"]
    if recipe != PLAIN_RECIPE:
        words.append(f"recipe={recipe}")
    if list(seeds) != [0]:
        words.append(f"seed={','.join(map(str, seeds))}")
    if records.folder.as_posix() != DEFAULT_RUNS:
        words.append(f"runs={records.folder}")
    return one_line(shlex.join(["python", "-m", "phd_exp", "-m", *words]))
