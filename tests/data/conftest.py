"""A small data set made without a renderer."""

from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import Split
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import SIDE, write_handmade

COUNTS: dict[Split, int] = {"train": 5, "test": 3}


@pytest.fixture
def spec(make_spec: Callable[..., DatasetSpec]) -> DatasetSpec:
    return make_spec("handmade", sensor_size=SIDE, f_range=(400.0, 600.0))


@pytest.fixture
def folder(tmp_path: Path, spec: DatasetSpec) -> DatasetFolder:
    return write_handmade(DatasetFolder(tmp_path / "handmade"), spec, COUNTS)
