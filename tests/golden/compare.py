"""How goldens are stored, and where found values differ from them.

A golden is a folder of files: JSON, JSON lines, CSV, or pictures (WebP without loss). `TOLERANCES` says how far the
numbers of each may differ on another machine: kernels for other instructions add in another order.
"""

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

PLACE = Path(__file__).parent
Tolerances = Sequence[tuple[str, float, float]]
"""Pattern of a value's path, relative and absolute tolerance of a number there; the first that matches counts."""
# With AVX2 and without vectors (ATEN_CPU_CAPABILITY=default, ONEDNN_MAX_CPU_ISA=SSE41, OPENBLAS_CORETYPE=Prescott,
# NPY_DISABLE_CPU_FEATURES), lines differ by at most 2e-7 m, or 5e-5 of other numbers; metadata and listed runs not at
# all; the report by 4e-8, except for paths, whose motion is the optimum of a flat function of four sequences (2 %).
# Trainings amplify the last bit: losses differ by 3e-6 in five steps and by 3e-4 in 20, final numbers by 9e-4.
LINES: Tolerances = [("_mm$", 1e-4, 1e-2), ("", 1e-4, 1e-5)]
TOLERANCES: Mapping[str, Tolerances] = {
    "configurations": (),
    "pictures": [("", 1e-9, 1e-12)],
    "predict": LINES,
    "fuse": LINES,
    "track": LINES,
    "graphs": [("covariance", 1e-3, 1e-5), *LINES],  # of another runtime
    "old_networks": LINES,
    "losses": [(r"losses.json\.[0-4]$|untrained", 1e-5, 1e-5), ("losses.json", 1e-3, 5e-4), ("", 5e-3, 1e-3)],
    "listed": (),
    "report": [("tracks.csv", 0.1, 0.0), ("", 1e-6, 1e-9)],
}
ABSENT = "nothing"
MEAN_LEVELS, LEVELS, SHARE = 0.1, 2, 0.999
"""Of pictures: the largest mean difference, and a difference that this share of all values keeps; levels of 255.

Other kernels of Cycles (CYCLES_CPU_NO_AVX2=1) change no pixel by more than 1, and the mean by 1e-4.
"""


def read(file: Path) -> Any:
    """The values of a file; a picture as an array of signed integers, shape (height, width, 3)."""
    if file.suffix == ".webp":
        with Image.open(file) as image:
            return np.asarray(image.convert("RGB")).astype(int)
    text = file.read_text()
    if file.suffix == ".csv":
        return [{key: _cell(cell) for key, cell in row.items()} for row in csv.DictReader(text.splitlines())]
    return json.loads(text) if file.suffix == ".json" else [json.loads(line) for line in text.splitlines()]


def write(file: Path, value: Any) -> None:
    """Write values so that `read` returns them and a change of one value changes one line."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".webp":
        Image.fromarray(np.asarray(value).astype(np.uint8)).save(file, lossless=True, exact=True, method=6)
    elif file.suffix == ".csv":
        with file.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, list(value[0]) if value else [], lineterminator="\n")
            writer.writeheader()
            writer.writerows(value)
    elif file.suffix == ".json":
        file.write_text(json.dumps(value, indent=1) + "\n")
    else:
        file.write_text("".join(json.dumps(line) + "\n" for line in value))


def compared(found: Any, golden: Any, tolerances: Tolerances, path: str = "") -> tuple[Any, list[str]]:
    """The found values with the golden one wherever both agree, and a line for each difference.

    A golden that is written again therefore changes only where values do.
    """
    if isinstance(found, dict | list) and type(found) is type(golden):
        now, old = (value if isinstance(value, dict) else dict(enumerate(value)) for value in (found, golden))
        parts = {key: compared(now[key], old.get(key, ABSENT), tolerances, f"{path}.{key}") for key in now}
        lines = [line for _, of_part in parts.values() for line in of_part]
        lines += [f"{path}.{key}: gone" for key in old if key not in now]
        values = {key: value for key, (value, _) in parts.items()}
        return values if isinstance(found, dict) else list(values.values()), lines
    if difference := _difference(found, golden, tolerances, path):
        return found, [f"{path}: {difference}"]
    return golden, []


def _difference(found: Any, golden: Any, tolerances: Tolerances, path: str) -> str:
    if isinstance(found, np.ndarray) and isinstance(golden, np.ndarray) and found.shape == golden.shape:
        off = np.abs(found - golden)
        if off.mean() < MEAN_LEVELS and (off <= LEVELS).mean() >= SHARE:
            return ""
        return f"{off.mean():.2f} levels off in the mean, {(off > LEVELS).mean():.2%} by more than {LEVELS}"
    elif isinstance(found, float) and isinstance(golden, float):
        relative, absolute = next((rest for pattern, *rest in tolerances if re.search(pattern, path)), (0.0, 0.0))
        if abs(found - golden) <= relative * abs(golden) + absolute:
            return ""
    elif type(found) is type(golden) and not isinstance(found, np.ndarray) and found == golden:
        return ""
    return f"{found!r} instead of {golden!r}"


def _cell(text: str) -> str | int | float:
    """The number that a cell of a CSV file states, or its text."""
    for kind in (int, float):
        with suppress(ValueError):
            if math.isfinite(value := kind(text)) and repr(value) == text:  # written as it is read
                return value
    return text
