"""Write the tables of results in README and the pages of this folder from its files.

    python docs/results/write.py                  # after the results have changed
    python docs/results/write.py --check          # exit status 1 if a page differs from them
    python docs/results/write.py --take report    # first take the numbers of a report

`runs.csv`, `tables.csv`, `calibration.csv` and `heads.csv` hold lines of the same files in `<report>/tables/`;
what is taken again replaces its lines. `photographs.csv`, `tracks.csv` and `further.csv` are of
notebooks and experiments that the pages name. Lines of models that left (docs/results/densities.md) were measured
with commit 05c5d40 (package version 0.1.0) or before.
A table stands between `<!-- results: NAME -->` and `<!-- end -->`.
"""

import argparse
import re
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pandas as pd

from phd_exp.records.choices import RunName
from phd_exp.reports.paper import PUBLISHED
from phd_exp.reports.paper_tables import DIGITS
from phd_exp.reports.table import NOTHING

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PAGES = ("README.md", *(f"docs/results/{page.name}" for page in sorted(HERE.glob("*.md"))))
BLOCK = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
KEYS = {
    "runs": ["preset", "data", "model", "seed", "overrides"],
    "tables": ["preset", "table", "data", "model", "estimate", "reading", "quantity"],
    "calibration": ["preset", "data", "model", "run"],
    "heads": ["preset", "data", "model", "seed", "overrides"],
}
DATA = ("default", "occl", "scale", "occl_scale")
PRESET = "full+strong"
CENTRAL = {"full+strong": ("data.xy_range=0.5",), "paper": ("data.xy_range=0.5", "data.image_format=webp")}
"""Preset -> the overrides of its runs with the authors' positions, one seed each."""


def take(report: Path) -> None:
    """Add the lines of a report; they replace those of the same runs."""
    for name, keys in KEYS.items():
        file = report / "tables" / f"{name}.csv"
        if not file.exists():  # of runs with overrides alone, which are in no table
            continue
        new, old = read(file), read(HERE / f"{name}.csv")
        taken = set(new[keys].itertuples(index=False, name=None))
        stays = [run not in taken for run in old[keys].itertuples(index=False, name=None)]
        both = pd.concat([old[stays], new]).sort_values(keys, kind="stable")
        both.to_csv(HERE / f"{name}.csv", index=False, lineterminator="\n")


def read(file: Path) -> pd.DataFrame:
    return pd.read_csv(file, dtype=str, keep_default_na=False)


def cells_of_tables() -> pd.DataFrame:
    """The cells of both tables, and those of the runs with the authors' positions."""
    runs = read(HERE / "runs.csv")
    central = [
        chosen(runs, preset=preset, overrides=central_run(preset).partition("-")[2]).assign(
            preset=f"{preset}, central", table="table1", n_seeds="1", best="False"
        )
        for preset in CENTRAL
    ]
    return pd.concat([read(HERE / "tables.csv"), *central], ignore_index=True)


def central_run(preset: str) -> str:
    """The name of the run's folder with the authors' positions."""
    return RunName(preset, "", "", seed=0, overrides=CENTRAL[preset]).folder(HERE).name


def chosen(lines: pd.DataFrame, **choice: str) -> pd.DataFrame:
    for key, value in choice.items():
        lines = lines[lines[key] == value]
    return lines


def error(cells: pd.DataFrame, quantity: str, digits: int, **choice: str) -> str:
    """A mean ± its 95 % interval, over seeds or, with one (†), over test images; bold if a paired test says best."""
    found = chosen(cells, quantity=f"{quantity}_error_mm", **choice)
    if found.empty or not found["mean"].iloc[0]:
        return NOTHING
    cell = found.iloc[0]
    mean, half = float(cell["mean"]), float(cell["high"]) - float(cell["mean"])
    digits += half < 0.5 * 10**-digits  # an interval is never ± 0
    text = f"{mean:.{digits}f} ± {half:.{digits}f}{'†' if cell['n_seeds'] == '1' else ''}"
    return f"**{text}**" if cell["best"] == "True" else text


def both_errors(cells: pd.DataFrame, **choice: str) -> str:
    """Projected and depth error."""
    found = [error(cells, quantity, digits, **choice) for quantity, digits in DIGITS.items()]
    return NOTHING if NOTHING in found else " / ".join(found)


def published(model: str, data: str) -> str:
    """Both errors of the paper."""
    return " / ".join(f"{PUBLISHED[model, data][quantity]:.{digits}f}" for quantity, digits in DIGITS.items())


def line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |\n"


def row(label: str, cells: list[str], *further: str) -> str:
    """A line, empty without any result."""
    return "" if set(cells) == {NOTHING} else line(label, *cells, *further)


def paper(label: str) -> str:
    """The paper's errors of the probabilistic model."""
    return line(label, *(published("probabilistic", data) for data in DATA))


def heading(*columns: str) -> str:
    return line("", *columns) + f"|---|{'---:|' * len(columns)}\n"


def summary(cells: pd.DataFrame) -> str:
    """The probabilistic model: positions, presets, recipes, one view and eight."""
    labels = {
        ("paper, central", "central", "mode"): "authors' positions: `preset=paper recipe=paper`",
        (f"{PRESET}, central", "central", "mode"): "authors' positions: `preset=full recipe=strong`",
        (PRESET, "central", "mode"): "central half: `preset=full recipe=strong`",
        (PRESET, "central", "eight views"): "central half: the same, eight symmetric views combined",
        (PRESET, "whole", "mode"): "whole field: `preset=full recipe=strong`",
    }
    table = heading(*DATA) + line(
        "paper: ResNet-50, 8,000 images", *(published("probabilistic", data) for data in DATA)
    )
    for (preset, reading, estimate), label in labels.items():
        choice = {"preset": preset, "estimate": estimate, "reading": reading}
        choice |= {"model": "probabilistic", "table": "table1"}
        table += row(label, [both_errors(cells, data=data, **choice) for data in DATA])
    return table


def readme(cells: pd.DataFrame, scores: pd.DataFrame) -> str:
    """The paper's errors, ours in the central half and in the whole field, and the share inside the 90 % region."""
    table = heading(*DATA) + paper("paper, central half of the field")
    choice = {"preset": PRESET, "estimate": "mode", "model": "probabilistic", "table": "table1"}
    for reading, label in {
        "central": "`preset=full recipe=strong`, central half",
        "whole": "the same, whole field",
    }.items():
        table += row(label, [both_errors(cells, data=data, reading=reading, **choice) for data in DATA])
    kept = chosen(scores, preset=PRESET, model="probabilistic", predictions="as trained", quantity="inside_90")
    shares = [chosen(of_seeds(kept), data=data)["value"].astype(float).mean() for data in DATA]
    return table + line("inside the 90 % region, whole field", *(f"{share:.1f} %" for share in shares))


def coverage(scores: pd.DataFrame) -> str:
    """Share inside the 90 % region and NEES of the probabilistic model with the authors' positions."""
    table = heading("`default`: inside the 90 % region", "NEES", "`occl`: inside the 90 % region", "NEES")
    labels = {"paper": "`preset=paper recipe=paper`", PRESET: "`preset=full recipe=strong`"}
    for (preset, label), kind in product(labels.items(), ("as trained", "recalibrated")):
        choice = {"preset": preset, "run": central_run(preset), "predictions": kind, "model": "probabilistic"}
        found = [chosen(scores, data=data, **choice) for data in DATA[:2]]
        cells = [score_of(lines) for lines in found]
        table += row(f"{label}, {kind}", [cell for pair in cells for cell in pair])
    ranges = [range_of(scores, "inside_90", 1, " %"), range_of(scores, "nees", 1, "")]
    return table + line("calibrated predictions, 95 % range", *ranges * 2)


def range_of(scores: pd.DataFrame, quantity: str, digits: int, unit: str) -> str:
    """The mean interval of calibrated predictions."""
    low, high = chosen(scores, quantity=quantity)[["low", "high"]].astype(float).mean()
    return f"{low:.{digits}f} to {high:.{digits}f}{unit}"


def score_of(lines: pd.DataFrame) -> tuple[str, str]:
    """Share inside the 90 % region (%), and NEES."""
    if lines.empty:
        return NOTHING, NOTHING
    found = lines.set_index("quantity")["value"].astype(float)
    return f"{found['inside_90']:.1f} %", f"{found['nees']:.1f}"


def models(cells: pd.DataFrame) -> str:
    """Table 1: every model in the whole field and in the central half."""
    table = heading(*DATA)
    for reading, label in {"whole": "*whole field*", "central": "*central half*"}.items():
        table += line(label, *([""] * len(DATA)))
        rows = [("mae_vz", "mode"), ("mae_logz", "mode"), ("probabilistic", "mode"), ("probabilistic", "eight views")]
        for model, estimate in rows:
            choice = {"preset": PRESET, "reading": reading, "model": model, "estimate": estimate, "table": "table1"}
            label = f"`{model}`{', eight views' if estimate == 'eight views' else ''}"
            table += row(label, [both_errors(cells, data=data, **choice) for data in DATA])
    return table + paper("paper, `probabilistic`")


def focal_length(cells: pd.DataFrame) -> str:
    """Table 2: models with different knowledge of the focal length, on `default`."""
    choice = {"preset": PRESET, "data": "default", "estimate": "mode", "table": "table2"}
    table = heading("whole field", "central half", "paper")
    for model in ("mae_xyz", "mae_constf", "probabilistic"):
        both = [both_errors(cells, model=model, reading=reading, **choice) for reading in ("whole", "central")]
        table += row(f"`{model}`", both, published(model, "default"))
    return table


def calibration(scores: pd.DataFrame) -> str:
    """Means over seeds of the scores of calibration, and of the interval that calibrated predictions have."""
    columns = {
        "inside_90": ("inside the 90 % region (%)", 1),
        "miscalibration_area": ("miscalibration area", 3),
        "depth_pit_area": ("PIT area of depth", 3),
        "nees": ("NEES", 2),
        "group_miscalibration": ("worst group", 3),
        "depth_ence": ("ENCE of depth", 2),
        "projected_ence": ("ENCE of projection", 2),
        "depth_crps_mm": ("CRPS of depth (mm)", 1),
    }
    table = heading(*(label for label, _ in columns.values()))
    for data in DATA:
        for kind in ("as trained", "recalibrated"):
            found = chosen(scores, preset=PRESET, data=data, model="probabilistic", predictions=kind)
            found = of_seeds(found)
            cells = [score(found, name, digits) for name, (_, digits) in columns.items()]
            table += row(f"`{data}`, {kind}", cells)
    return table


def score(lines: pd.DataFrame, quantity: str, digits: int) -> str:
    """The mean over the lines of a quantity and of its interval; a dash without one."""
    found = chosen(lines, quantity=quantity)
    if found.empty:
        return NOTHING
    value, low, high = found[["value", "low", "high"]].astype(float).mean()
    return f"{value:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def of_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """The scores of runs that differ in their seed alone."""
    return scores[scores["run"].str.fullmatch(r"seed\d+")]


def heads(lines: pd.DataFrame) -> str:
    """Densities of other shapes: the mean over seeds, and the difference to `probabilistic` with its interval."""
    columns = {
        "nll": ("NLL (nats)", 2),
        "depth_crps_mm": ("CRPS of depth (mm)", 1),
        "inside_90": ("inside 90 % region (%)", 0),
        "log_volume": ("log volume of the conformal 90 % region", 2),
        "projected_error_mm": ("projected error (mm)", 1),
        "depth_error_mm": ("depth error (mm)", 1),
        "fused_error_mm": ("fused error, two cameras (mm)", 1),
    }
    table = heading(*(label for label, _ in columns.values()))
    for data in DATA:
        of_data = chosen(lines, data=data)
        table += line(f"*`{data}`*", *[""] * len(columns)) if len(of_data) else ""
        for model in dict.fromkeys(["probabilistic", "free_axis", *of_data["model"]]):
            cells = [compared(chosen(of_data, model=model, quantity=name), n) for name, (_, n) in columns.items()]
            table += row(f"`{model}`", cells)
    return table


def compared(lines: pd.DataFrame, digits: int) -> str:
    """A mean; below it the difference to the reference; bold if better by a test."""
    if lines.empty:
        return NOTHING
    first, mean = lines.iloc[0], lines["value"].astype(float).mean()
    text = f"**{mean:.{digits}f}**" if first["better"] == "True" else f"{mean:.{digits}f}"
    if not first["difference"]:
        return text
    gap = float(first["difference"])
    return f"{text}<br>{gap:+.{digits}f} ± {float(first['high']) - gap:.{digits}f}"


def photographs(lines: pd.DataFrame) -> str:
    """Depth errors on photographs, by set."""
    columns = {
        "depth_error_percent": "depth error (%)",
        "projected_error_mm": "projected error (mm)",
        "inside_50": "inside 50 %",
        "inside_90": "inside 90 %",
        "unfamiliar": "unfamiliar",
    }
    table = heading(*columns.values())
    for name, of_set in lines.groupby("object", sort=False):
        table += line(f"*{name}, {of_set['photographs'].iloc[0]} photographs*", *[""] * len(columns))
        for _, one in of_set.iterrows():
            table += line(one["prediction"], *(one[column] or NOTHING for column in columns))
    return table


def tracks(lines: pd.DataFrame) -> str:
    """Paths against single frames: errors, ratios and squared errors, a row for each run and kind of sequence."""
    columns = {
        "single frames (mm)": ("depth_error_mm", "single", 0),
        "Kalman": ("ratio/depth_error_mm", "kalman", 2),
        "independent": ("ratio/depth_error_mm", "independent", 2),
        "weighted": ("ratio/depth_error_mm", "slow", 2),
        "hidden": ("ratio/hidden/depth_error_mm", "slow", 2),
        "closer than Kalman (mm)": ("gain", "slow", 0),
        "squared error: Kalman": ("nees", "kalman", 1),
        "weighted ": ("nees", "slow", 2),
    }
    table = heading("sequences", *columns)
    keys = ["data", "cameras", "frames", "model", "run"]
    for (data, cameras, frames, model, run), found in lines.groupby(keys, sort=False):
        found = found.rename(columns={"mean": "value"})
        cells = [score(chosen(found, method=method), name, n) for name, method, n in columns.values()]
        several = f", {cameras} cameras" if cameras != "1" else ""
        label = f"`{data}`, `{model}`, {run.partition('-')[0]}"
        table += line(label, f"{found['n_sequences'].iloc[0]} × {frames}{several}", *cells)
    return table


def further(lines: pd.DataFrame) -> str:
    """One table of `further.csv`."""
    columns = list(dict.fromkeys(lines["column"]))
    table = heading(*columns)
    for name, found in lines.groupby("row", sort=False):
        values = dict(zip(found["column"], found["value"], strict=True))
        table += line(str(name), *(values.get(column) or NOTHING for column in columns))
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--take", type=Path, metavar="REPORT")
    arguments = parser.parse_args()
    if arguments.take:
        take(arguments.take)
    of_cells: list[Callable[[pd.DataFrame], str]] = [summary, models, focal_length]
    cells = cells_of_tables()
    tables = {table.__name__: table(cells) for table in of_cells}
    of_scores = [calibration, coverage]
    scores = read(HERE / "calibration.csv")
    tables |= {table.__name__: table(scores) for table in of_scores}
    tables["readme"] = readme(cells, scores)
    tables["heads"] = heads(read(HERE / "heads.csv"))
    tables |= {table.__name__: table(read(HERE / f"{table.__name__}.csv")) for table in (photographs, tracks)}
    tables |= {str(name): further(found) for name, found in read(HERE / "further.csv").groupby("table")}
    differs = False
    for name in PAGES:
        before = (ROOT / name).read_text()
        after = BLOCK.sub(lambda block: f"{block[1]}\n{tables[block[2]]}\n{block[3]}", before)
        if before == after:
            continue
        if arguments.check:
            print(f"{name}: differs from docs/results; run python docs/results/write.py", file=sys.stderr)
            differs = True
        else:
            (ROOT / name).write_text(after)
    return int(differs)


if __name__ == "__main__":
    sys.exit(main())
