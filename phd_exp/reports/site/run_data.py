"""What pages share of a run: one JSON in `data/<slug>.js`, a script because pages opened as files may not fetch."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from phd_exp.evaluation.predictions import Band
from phd_exp.records.errors import RunError
from phd_exp.reports.collect import Run
from phd_exp.reports.fusion_table import headline
from phd_exp.reports.site.charts import Chart
from phd_exp.reports.site.dossier import Dossier, read_config, slug_of
from phd_exp.reports.site.fusion_charts import fusion_charts
from phd_exp.reports.site.gallery import images_folder
from phd_exp.reports.site.quantities import SCORES
from phd_exp.reports.site.run_charts import calibration_charts, learning_charts, strata_charts


@dataclass(frozen=True)
class RunData:
    """What the overview and the comparison need of a run.

    Attributes:
        key: of the files and the code that all of it follows from.
        n: test samples; None without predictions.
        scores, recalibrated: means over the test split with their intervals; the second empty for most.
        config: every value of config.yaml, by its path.
        fusion: in one line, what fusion gives; empty where several views were not recorded.
    """

    key: str
    slug: str
    preset: str
    data: str
    model: str
    run: str
    title: str
    state: str
    n: int | None
    scores: dict[str, Band]
    recalibrated: dict[str, Band]
    config: dict[str, str]
    charts: dict[str, Chart]
    fusion: str = ""


_ADAPTER: TypeAdapter[RunData] = TypeAdapter(RunData)


def gather(dossier: Dossier, key: str) -> RunData:
    """The data of a run from its dossier."""
    assessment = dossier.assessment
    before, after = (assessment.before, assessment.after) if assessment else (None, None)
    charts = calibration_charts(before, after) if before else {}
    charts |= learning_charts(dossier)
    charts |= strata_charts(before) if before else {}
    charts |= fusion_charts(dossier.fusion) if dossier.fusion else {}
    run = dossier.run
    return RunData(
        key=key,
        slug=slug_of(run),
        preset=run.preset,
        data=run.data,
        model=run.model,
        run=run.folder.path.name,
        title=f"{run.model} on {run.data}",
        state=run.state,
        n=before.n if before else None,
        scores=_in_order(before.scores) if before else {},
        recalibrated=_in_order(after.scores) if after else {},
        config=dict(dossier.config),
        charts=charts,
        fusion=headline(dossier.fusion) if dossier.fusion else "",
    )


def _in_order(scores: Mapping[str, Band]) -> dict[str, Band]:
    """As a page lists them; those it has not met come last."""
    places = {name: place for place, name in enumerate(SCORES)}
    return dict(sorted(scores.items(), key=lambda item: places.get(item[0], len(places))))


def as_script(name: str, content: Any) -> str:
    """`phdExp.receive("<name>", {...});`, safe in HTML and JavaScript: without <, >, & and line separators."""
    text = f"phdExp.receive({json.dumps(name)}, {json.dumps(content, allow_nan=False, separators=(',', ':'))});\n"
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def run_script(run: RunData) -> str:
    """What the charts of a run show, as the script of its page."""
    return as_script(run.slug, asdict(run))


def read_script(file: Path) -> RunData | None:
    """The run that `run_script` wrote; None where there is none or it is of another version."""
    try:
        text = file.read_text()
        return _ADAPTER.validate_json(text[text.index("{") : text.rindex("}") + 1])
    except (OSError, ValueError, ValidationError):
        return None


def key_of(run: Run) -> str:
    """A digest that changes whenever a page of the run would: its files, its state, its images, this code."""
    files = [file for file in run.folder.path.iterdir() if file.is_file() and not file.name.startswith(".")]
    try:
        images = images_folder(read_config(run.folder))
    except (RunError, OSError):
        images = None
    seen = [_stamp(file) for file in sorted([*files, *([images] if images else [])])]
    return hashlib.sha256(
        json.dumps([_code(), run.state, run.detail, run.overrides, seen]).encode()
    ).hexdigest()[:16]


def _stamp(path: Path) -> tuple[str, int, int]:
    try:
        stat = path.stat()
    except OSError:
        return str(path), 0, 0
    return str(path), stat.st_mtime_ns, stat.st_size


@cache
def _code() -> str:
    package = Path(__file__).parents[2]
    files = sorted(file for kind in ("py", "html") for file in package.rglob(f"*.{kind}"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
