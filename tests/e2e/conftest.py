"""Real renders, small enough for seconds: a quarter of the sensor, the same field of view."""

from collections.abc import Callable
from pathlib import Path

import pytest

QUICK = (
    "preset=smoke",
    "data.sensor_size=64",
    "data.f_range=[343,571]",
    "data.n_train=16",
    "data.n_test=6",
    "data.batch_size=8",
    "trainer.progress_bar=false",
)


@pytest.fixture(scope="session")
def renders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of data sets for all tests: whoever needs a data set first renders it."""
    return tmp_path_factory.mktemp("renders")


@pytest.fixture
def train(phd_exp: Callable, renders: Path) -> Callable:
    """A run at the smallest size, on the shared data sets."""
    return lambda *arguments: phd_exp(*arguments, *QUICK, f"data.root={renders}")
