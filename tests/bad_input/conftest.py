"""One sound place for all tests, and a copy of it for each."""

import os
from pathlib import Path

import pytest

from phd_exp.records.processes import held
from tests.bad_input.place import Place, copied, make


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by whichever test process comes first; nobody changes it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "sound_place"
    with held(folder.with_suffix(".lock"), waiting="another process makes the sound place"):
        if not folder.exists():
            making = folder.with_suffix(".making")
            making.mkdir()
            make(making)
            making.rename(folder)
    return folder


@pytest.fixture
def place(sound: Path, tmp_path: Path) -> Place:
    return copied(sound, tmp_path)
