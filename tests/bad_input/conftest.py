"""One sound place for all tests, and a copy of it for each."""

from pathlib import Path

import pytest

from tests.bad_input.place import Place, copied, make
from tests.support.recorded import once


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Never changed by a test."""
    return once(tmp_path_factory, "sound_place", make)


@pytest.fixture
def place(sound: Path, tmp_path: Path, undrawn: None) -> Place:
    return copied(sound, tmp_path)
