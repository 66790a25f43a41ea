"""A data set folder made without a renderer."""

from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import write_handmade


@pytest.fixture
def dataset(tmp_path: Path, make_spec: Callable[..., DatasetSpec]) -> DatasetFolder:
    """Five training and two test samples."""
    return write_handmade(DatasetFolder(tmp_path / "default"), make_spec(), {"train": 5, "test": 2})
