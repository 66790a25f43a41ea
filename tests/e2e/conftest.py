"""Real renders, small enough for seconds: a quarter of the sensor, the same field of view."""

from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.__main__ import main
from phd_exp.records.runs import RunFolder, find_runs
from tests.support import own_parts
from tests.support.recorded import once, shared
from tests.support.untrained import NARROW, SIDE

QUICK = (
    "preset=smoke",
    "data.sensor_size=64",
    "data.f_range=[343,571]",
    "data.n_train=16",
    "data.n_held_out=4",
    "data.n_test=6",
    "data.batch_size=8",
    "data.workers=1",  # a start of Blender costs more than the images
    "trainer.progress_bar=false",
    "trainer.threads=1",  # of the two cores, pytest-xdist keeps the other busy
)


QUICKER = ("trainer.max_epochs=1", "logger=none", f"data.image_size={SIDE}", *NARROW)


def trained(runs: Path, *arguments: str) -> None:
    """Train one run into its own folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["phd_exp"])
        patch.setattr("phd_exp.reports.figures.draw_calibration", lambda curves, file: None)
        assert main([*arguments, *QUICKER, f"runs={runs}"]) == 0


@pytest.fixture(scope="session")
def run(renders: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """On a rendered data set, whose images shrink by no whole number; nobody changes it."""
    words = (*QUICK, f"data.root={renders}")
    (found,) = find_runs(once(tmp_path_factory, "rendered run", lambda runs: trained(runs, *words)))
    return found


@pytest.fixture(scope="session")
def renders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of data sets for all tests, in whatever process: whoever needs a data set first renders it."""
    return shared(tmp_path_factory) / "renders"


@pytest.fixture
def own(phd_exp: Callable, tmp_path: Path, undrawn: None, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """A run of a second in a folder with own parts, without the picture of its calibration."""
    own_parts.write_own_parts(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return lambda *words: phd_exp(*own_parts.QUICK, *words)


@pytest.fixture
def train(phd_exp: Callable, renders: Path) -> Callable:
    """A run at the smallest size, on the shared data sets."""
    return lambda *arguments: phd_exp(*QUICK, f"data.root={renders}", *arguments)
