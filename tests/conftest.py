"""What all tests share: shapes checked at run time, the command line called in this process."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from shutil import which
from typing import Any

import pytest
import torch
from jaxtyping import install_import_hook

from phd_exp.cli import conf_folder, jobs
from phd_exp.records import runs
from phd_exp.records.spec import DatasetSpec
from tests.support.shapes import next_test

# before anything is imported: every annotated function of these modules checks its shapes while tests run; numba
# compiles the other modules of fusion
FUSION = ("fusion.fuse", "fusion.gaussian", "fusion.pose", "fusion.problems", "fusion.views")
TRACKS = tuple(f"fusion.tracks.{name}" for name in ("chain", "lost", "motion", "shear", "slow"))
NUMERIC = ("optics", "geometry", "distributions", "losses", "metrics", "models", "data", "evaluation")
HOOKED = (*NUMERIC, *FUSION, *TRACKS)
install_import_hook([f"phd_exp.{name}" for name in HOOKED], "tests.support.shapes.first_calls")


torch.set_num_threads(1)
runs.git_commit = cache(runs.git_commit)  # some 400 runs are recorded


@pytest.fixture(autouse=True)
def checked_shapes() -> None:
    """The first calls of each function in this test have their shapes checked."""
    next_test()


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Torch computes on one thread, whatever the test before has set.

    Two test processes have two cores: more threads would wait for each other, far longer than they compute.
    """
    yield
    torch.set_num_threads(1)


@dataclass(frozen=True)
class Outcome:
    """What a command printed and how it ended."""

    status: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """Requires that the command was refused on one line; the line without `error: `."""
        assert self.status in (1, 2), self
        (line,) = self.err.splitlines()
        assert line.startswith("error: ")
        return line.removeprefix("error: ")


@pytest.fixture(scope="session")
def composed() -> Callable[..., dict[str, Any]]:
    """The configuration that Hydra composes from overrides, as plain containers; each composed once."""

    @cache
    def compose(*overrides: str) -> dict[str, Any]:
        return jobs.composed(overrides)

    return lambda *overrides: deepcopy(compose(*overrides))


@pytest.fixture(scope="session")
def make_spec(composed: Callable[..., dict[str, Any]]) -> Callable[..., DatasetSpec]:
    """What conf/data says of a variant, with some values changed; of an unknown one, what it says of `default`."""

    @cache
    def values(variant: str) -> dict[str, Any]:
        known = (conf_folder() / "data" / f"{variant}.yaml").exists()
        data = composed(f"data={variant if known else 'default'}")["data"]
        return {key: value for key, value in data.items() if key in DatasetSpec.model_fields}

    return lambda variant="default", **changes: DatasetSpec(**(values(variant) | {"variant": variant} | changes))


@pytest.fixture
def phd_exp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., Outcome]:
    """`python -m phd_exp ARGUMENTS` in an empty folder, but in this process."""
    from phd_exp.__main__ import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["phd_exp"])
    monkeypatch.setenv("WANDB_ERROR_REPORTING", "false")  # no network look-ups

    def run(*arguments: str) -> Outcome:
        capfd.readouterr()
        status = main(list(arguments))
        out, err = capfd.readouterr()
        return Outcome(status, out, err)

    return run


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs do not draw their calibration curves, which takes half a second each."""
    monkeypatch.setattr("phd_exp.reports.figures.draw_calibration", lambda curves, file: None)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A real browser, without a network."""
    executable = which("chromium") or which("chromium-browser") or which("google-chrome")
    if executable is None:
        pytest.skip("no Chromium is installed (apt-get install chromium)")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=executable, args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        )
        yield browser
        browser.close()
