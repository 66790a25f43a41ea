"""The paper's figures from recorded runs, as PDF and PNG."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.written import Written
from phd_exp.reports.figures import LABELS, decades, draw_birds_eye, draw_identity, draw_on_image, encoded
from phd_exp.reports.gallery import curves_of, images_folder, load_image
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.report import Report
from phd_exp.reports.runs import PROBABILISTIC, Run
from phd_exp.reports.table import file_stem

LONGEST_NAME = 30


def write_figures(report: Report, folder: Path) -> list[str]:
    """Write the paper's figures for every preset and data set, as PDF and PNG; returns their names.

    Each shows the finished probabilistic run without overrides that has the lowest seed.
    """
    names, plans = [], dict[str, Callable[[], Figure | None]]()
    for preset in report.presets:
        runs = _first_seeds(report, preset)
        plans[file_stem("calibration", preset)] = partial(_calibration, runs)
        plans[file_stem("precision", preset)] = partial(_precision, runs)
        plans |= {file_stem("level_curves", preset, run.data): partial(_level_curves, run) for run in runs}
    with Written(folder, "report") as written:
        for name, draw in plans.items():
            files = report.notes.attempt(partial(_files, draw), f"figure {name}: ") or {}
            for kind, content in files.items():
                written.write(f"{name}.{kind}", content)
            names += [name] if files else []
    return names


def _files(draw: Callable[[], Figure | None]) -> dict[str, bytes]:
    """The bytes of a figure by file type; empty if there is nothing to draw."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # missing letters of the font, extreme numbers
        figure = draw()
        return {kind: encoded(figure, kind, dpi=250) for kind in ("png", "pdf")} if figure else {}


def _first_seeds(report: Report, preset: str) -> list[Run]:
    order = dict.fromkeys([*(data for _, data in PUBLISHED), *sorted({run.data for run in report.runs})])
    found = {
        run.data: run
        for run in sorted(report.runs, key=lambda run: -(run.seed or 0))
        if (run.preset, run.model) == (preset, PROBABILISTIC) and run.overrides is None and run.measured.before
    }
    return [found[data] for data in order if data in found]


def _calibration(runs: Sequence[Run]) -> Figure | None:
    """Mean squared error against predicted variance: depth on the left, projection on the right.

    Source: paper, figure "correlation between predicted variance and empirical variance".
    """
    figure = Figure(figsize=(7.2, 3.5), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), LABELS, strict=True):
        curves = [before.curves[f"{name}_calibration"] for run in runs if (before := run.measured.before)]
        values = [value for curve in curves for value in (*curve.x, *curve.y)]
        if decades(values) is None:
            return None
        draw_identity(axes, name, values)
        for run, curve, style in zip(runs, curves, _styles(), strict=False):
            axes.plot(curve.x, curve.y, linewidth=1.3, label=_plain(run.data), **style)
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


def _precision(runs: Sequence[Run]) -> Figure | None:
    """Mean a and mean |A| over the epochs, solid on the test and faint on the training split.

    Source: paper, figure "average precision parameters increase during the training".
    """
    figure = Figure(figsize=(7.2, 3.1), layout="constrained")
    panels = (("depth_precision", "mean a"), ("projected_precision", "mean |A|"))
    for axes, (key, label) in zip(figure.subplots(1, 2), panels, strict=True):
        for run, style in zip(runs, _styles(), strict=False):
            for split, alpha, name in (("train", 0.4, None), ("test", 1.0, _plain(run.data))):
                series = run.metrics.get(f"{split}/{key}", ())
                known = [(x, y) for x, y in zip(run.epochs, series, strict=False) if y is not None and y > 0]
                if known:
                    axes.plot(*zip(*known, strict=True), linewidth=1.3, alpha=alpha, label=name, **style)
        if not axes.lines:
            return None
        axes.set(yscale="log", xlabel="epochs of training", ylabel=label)
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


def _level_curves(run: Run) -> Figure | None:
    """Level curves on the test image with the median NLL, and from above; None without images.

    Source: paper, its first figure.
    """
    source = images_folder(run.config)
    if source is None:
        return None
    table = read_table(run.folder.predictions)
    place = int(np.argsort(table["nll"])[len(table["nll"]) // 2])
    row = {name: column[place] for name, column in table.items()}
    image, curves = load_image(source, str(row["file_name"])), curves_of(row)
    if image is None or curves is None:
        return None
    truth = np.array([row[axis] for axis in "xyz"])
    figure = Figure(figsize=(6.8, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_on_image(left, curves, np.asarray(image), float(row["f"]), float(row["S"]), truth)
    draw_birds_eye(right, curves, truth)
    return figure


def _styles() -> Iterator[dict[str, str]]:
    """Colours that colour-blind readers can distinguish, and dashes."""
    colours = ("#0072b2", "#c44e00", "#007d5a", "#a3487c", "#8a6200")
    return cycle(
        {"color": colour, "linestyle": dash}
        for colour, dash in zip(colours, ("-", "--", ":", "-.", "-"), strict=True)
    )


def _plain(name: str) -> str:
    """A name for a legend: shortened, and without dollar signs, which matplotlib reads as mathematics."""
    short = name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}…"
    return short.replace("$", r"\$")
