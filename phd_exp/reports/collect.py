"""Every recorded run under a folder, as rows of a table."""

from dataclasses import dataclass
from pathlib import Path

from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder, find_runs
from phd_exp.reports.paper import PUBLISHED, Published


@dataclass(frozen=True)
class RunRow:
    """What the table says of one run; numbers are None until the run has finished."""

    preset: str
    data: str
    model: str
    run: str
    state: str
    projected_error_mm: float | None = None
    depth_error_mm: float | None = None
    nll: float | None = None

    @property
    def published(self) -> Published | None:
        return PUBLISHED.get((self.model, self.data))


def collect(runs: Path) -> list[RunRow]:
    """A row a run, by preset, data set, model and seed; a run whose record is broken is named with its error."""
    return [_row(folder, runs) for folder in find_runs(runs)]


def _row(folder: RunFolder, runs: Path) -> RunRow:
    preset, data, model, run = folder.path.relative_to(runs).parts
    try:
        status = folder.status()
        results = folder.results() if status and status.state == "finished" else {}
    except RunError as error:
        return RunRow(preset, data, model, run, state=f"broken: {error}")
    state: str = status.state if status else "unknown"
    if state == "running" and not folder.is_held():
        state = "broken off; the same command goes on"
    if status and status.error and state == "failed":
        state += f": {' '.join(status.error.split())}"
    return RunRow(
        preset,
        data,
        model,
        run,
        state,
        projected_error_mm=results.get("test/projected_error_mm"),
        depth_error_mm=results.get("test/depth_error_mm"),
        nll=results.get("test/nll"),
    )
