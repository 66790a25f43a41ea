"""The paper's figures from recorded runs, as PNG and PDF."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phd_exp.reports.collect import LEAF, PROBABILISTIC
from phd_exp.reports.figures import draw_birds_eye, draw_on_image, write_figure
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.site.charts import Trace
from phd_exp.reports.site.gallery import curves_of, images_folder, load_image
from phd_exp.reports.site.run_data import RunData

CALIBRATION, PRECISION, LEVEL_CURVES = "calibration", "precision", "level_curves"
"""What the files are called, before preset and data set."""
_STYLES = (("#0072b2", "-"), ("#c44e00", "--"), ("#007d5a", ":"), ("#a3487c", "-."), ("#8a6200", "-"))
_ORDER = list(dict.fromkeys(data for _, data in PUBLISHED))


def first_seeds(runs: Iterable[RunData]) -> list[RunData]:
    """Of each preset and data set, the finished probabilistic run with the lowest seed and no other override."""
    first: dict[tuple[str, str], tuple[int, RunData]] = {}
    for run in runs:
        name = LEAF.fullmatch(run.run)
        if run.model != PROBABILISTIC or not run.scores or name is None or name[2]:
            continue
        place, seed = (run.preset, run.data), int(name[1])
        if place not in first or seed < first[place][0]:
            first[place] = seed, run
    order = {data: place for place, data in enumerate(_ORDER)}
    return sorted(
        (run for _, run in first.values()), key=lambda run: (run.preset, order.get(run.data, 99), run.data)
    )


def write_figures(preset: str, runs: Sequence[RunData], folder: Path) -> list[Path]:
    """Precision and calibration of a preset, a line a run: `{precision,calibration}-<preset>.{png,pdf}`.

    The calibration as PDF comes last, because it says that the others are there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {PRECISION: _precision(runs), CALIBRATION: _calibration(runs)}
    return [
        file
        for name, figure in drawn.items()
        if figure is not None
        for file in write_figure(figure, folder / f"{name}-{preset}")
    ]


def _calibration(runs: Sequence[RunData]) -> Figure | None:
    """Mean squared error against predicted variance: depth on the left, projection on the right.

    Source: paper, figure "correlation between predicted variance and empirical variance".
    """
    figure = Figure(figsize=(7.2, 3.5), layout="constrained")
    for axes, key in zip(figure.subplots(1, 2), ("depth_calibration", "projected_calibration"), strict=True):
        shown = [run for run in runs if key in run.charts]
        if not shown:
            return None
        diagonals = [trace["x"] for run in shown for trace in _traces(run, key, "identity")]
        ends = min(x[0] for x in diagonals), max(x[1] for x in diagonals)
        axes.plot(ends, ends, "--", color="tab:red", linewidth=1)
        _lines(axes, shown, key, "before")
        layout = shown[0].charts[key].layout
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
        axes.set(xlabel=layout["xaxis"]["title"]["text"], ylabel=layout["yaxis"]["title"]["text"])
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


def _precision(runs: Sequence[RunData]) -> Figure | None:
    """Mean a and mean |A| over the epochs, solid on the test and faint on the training split.

    Source: paper, figure "average precision parameters increase during the training".
    """
    figure = Figure(figsize=(7.2, 3.1), layout="constrained")
    for axes, key, label in zip(
        figure.subplots(1, 2), ("depth_precision", "projected_precision"), ("mean a", "mean |A|"), strict=True
    ):
        shown = [run for run in runs if f"learning_{key}" in run.charts]
        if not shown:
            return None
        _lines(axes, shown, f"learning_{key}", "train", alpha=0.4)
        _lines(axes, shown, f"learning_{key}", "test")
        axes.set(yscale="log", xlabel="epochs of training", ylabel=label)
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


def _lines(axes: Axes, runs: Sequence[RunData], key: str, role: str, alpha: float = 1.0) -> None:
    for place, run in enumerate(runs):
        colour, dash = _STYLES[place % len(_STYLES)]
        for trace in _traces(run, key, role):
            label = None if alpha < 1 else run.data
            axes.plot(*_values(trace), dash, color=colour, alpha=alpha, linewidth=1.3, label=label)


def _traces(run: RunData, key: str, role: str) -> list[Trace]:
    return [trace for trace in run.charts[key].data if trace["meta"]["role"] == role]


def _values(trace: Trace) -> tuple[np.ndarray, np.ndarray]:
    return np.array(trace["x"], dtype=float), np.array(trace["y"], dtype=float)


def write_level_curves(table: pa.Table, config: Mapping[str, str], stem: Path) -> list[Path]:
    """Level curves on the test image whose negative log density is the median, and from above; [] without images.

    Source: paper, its first figure.
    """
    source = images_folder(config)
    if source is None:
        return []
    nll = table["nll"].to_numpy()
    place = int(np.argsort(nll)[len(nll) // 2])
    row = {name: table[name][place].as_py() for name in table.column_names}
    image, curves = load_image(source, row["file_name"]), curves_of(row)
    if image is None or curves is None:
        return []
    truth = np.array([row[axis] for axis in "xyz"], dtype=float)
    figure = Figure(figsize=(6.8, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_on_image(left, curves, np.asarray(image), float(row["f"]), float(row["S"]), truth)
    draw_birds_eye(right, curves, truth)
    stem.parent.mkdir(parents=True, exist_ok=True)
    return write_figure(figure, stem)
