"""Report, predict and export, killed at any moment: they leave whole files, and in the end the same bytes."""

import random
import shutil
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from phd_exp.records.runs import RunFolder
from tests.support.processes import begin
from tests.support.site_runs import write_runs
from tests.support.untrained import NOWHERE, SMALL, untrained

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

KILLS = {"report": 20, "predict": 20, "export": 5}
VERBS = {
    "report": ["phd_exp.cli.report", "phd_exp.reports.paper_figures", "phd_exp.reports.site.build"],
    "predict": ["phd_exp.cli.predict", "phd_exp.inference.loading", "phd_exp.inference.pictures"],
    "export": ["phd_exp.cli.export", "phd_exp.inference.loading", "phd_exp.inference.onnx"],
}
"""What a process that is started to be killed has imported before."""


@pytest.fixture(params=VERBS)
def verb(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def command(verb: str, request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[Path], list[str]]:
    """The words with which a verb writes into a folder."""
    if verb == "report":
        runs = write_runs(tmp_path)
        return lambda out: [verb, f"runs={runs}", f"out={out}"]
    if verb == "export":  # of a baseline, whose graph takes a tenth of the time
        composed = request.getfixturevalue("composed")
        baseline = untrained(tmp_path / "baseline", composed(*SMALL, *NOWHERE, "model=mae_vz"))
        return lambda out: [verb, f"run={baseline.path}", f"out={out / 'network.onnx'}"]
    run: RunFolder = request.getfixturevalue("run")
    images = request.getfixturevalue("renders") / "default" / "test"
    return lambda out: [verb, f"run={run.path}", f"folder={images}", f"out={out}"]


def end(process: BaseProcess) -> None:
    process.join()
    assert process.exitcode == 0


def contents(out: Path) -> dict[str, bytes]:
    """Every file, by its path, without those that have not their name yet."""
    files = [path for path in out.rglob("*") if path.is_file() and path.suffix not in (".tmp", ".written")]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def leftovers(out: Path) -> list[Path]:
    return list(out.rglob(".*.tmp"))


def killed(process: BaseProcess, out: Path, most: int, moments: random.Random) -> None:
    """Kill the process a moment after 1 to `most` further files, unless it ends before."""
    before, enough = written(out), moments.randint(1, most)
    while process.is_alive() and len(written(out) - before) < enough:
        time.sleep(0.001)
    time.sleep(moments.uniform(0.0, 0.05))
    process.kill()


def written(out: Path) -> set[tuple[Path, int]]:
    """The files and when they were written, those without their name among them."""
    found = set()
    for path in out.rglob("*"):
        try:
            found.add((path, path.stat().st_mtime_ns))
        except FileNotFoundError:  # it has its name now
            continue
    return found


def test_killed_at_any_moment_it_leaves_whole_files_and_ends_as_undisturbed(
    verb: str, command: Callable, tmp_path: Path
) -> None:
    """Each file is, to the byte, the one that an undisturbed process writes; a journal is the beginning of it."""
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    end(begin(command(undisturbed), VERBS[verb]))
    whole = contents(undisturbed)
    moments, kills, torn = random.Random(0), 0, 0
    before: dict[str, bytes] = {}
    most = min(6, len(whole) + 1)  # a file is seen without its name, and with it
    while kills < KILLS[verb]:
        amid = moments.randint(1, min(most, len(whole))) if kills % 2 == 0 else 0
        process = begin(command(out), VERBS[verb], amid)
        if not amid:
            killed(process, out, most, moments)
        process.join()
        if process.exitcode == -signal.SIGKILL:
            kills += 1
            torn += len(leftovers(out)) > 0
            now = contents(out)
            assert before.keys() <= now.keys(), "nothing that was there is lost"
            for name, content in now.items():
                assert whole[name].startswith(content) if name.endswith(".jsonl") else whole[name] == content
            before = now
        else:
            assert contents(out) == whole
            shutil.rmtree(out)
            before = {}
    assert torn, "a kill has met a file that was being written"
    end(begin(command(out), VERBS[verb]))
    assert contents(out) == whole
    assert not leftovers(out)
