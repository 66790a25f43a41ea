"""Real renders, small enough for seconds: a quarter of the sensor, the same field of view."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

QUICK = (
    "preset=smoke",
    "data.sensor_size=64",
    "data.f_range=[343,571]",
    "data.n_train=16",
    "data.n_held_out=4",
    "data.n_test=6",
    "data.batch_size=8",
    "trainer.progress_bar=false",
    "trainer.threads=1",  # of the two cores, pytest-xdist keeps the other busy
)


@pytest.fixture(scope="session")
def renders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of data sets for all tests, in whatever process: whoever needs a data set first renders it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    return shared / "renders"


@pytest.fixture
def train(phd_exp: Callable, renders: Path) -> Callable:
    """A run at the smallest size, on the shared data sets."""
    return lambda *arguments: phd_exp(*QUICK, f"data.root={renders}", *arguments)
