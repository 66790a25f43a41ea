"""A rendered folder is read by other programmes as it is: Hugging Face `datasets`."""

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.scenes import SampleRecord
from tests.support.renders import pixels


@pytest.fixture(params=["small", "small_webp"])
def folder(request: pytest.FixtureRequest) -> DatasetFolder:
    """Two splits, as PNG and as WebP."""
    found = request.getfixturevalue(request.param)
    assert isinstance(found, DatasetFolder)
    return found


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Hugging Face `datasets`; what it may write and whom it may call, it asks once, as it is imported."""
    for name in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE", "HF_HUB_DISABLE_TELEMETRY"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    return importlib.import_module("datasets")


def as_read(record: SampleRecord) -> dict[str, object]:
    """A record as JSON has it, but for the image's name."""
    values: dict[str, object] = json.loads(record.model_dump_json())
    del values["file_name"]
    return values


def test_hugging_face_reads_it(folder: DatasetFolder, datasets: ModuleType, tmp_path: Path) -> None:
    data = datasets.load_dataset("imagefolder", data_dir=str(folder.root), cache_dir=str(tmp_path / "cache"))
    assert set(data) == set(SPLITS)
    for split in SPLITS:
        records = folder.records(split)
        assert data[split].num_rows == len(records) > 0
        assert set(data[split].column_names) == {"image", *as_read(records[0])}
        for row, record in zip(data[split], records, strict=True):
            image = row.pop("image")
            assert (np.asarray(image) == pixels(folder, record)).all()
            assert row == as_read(record)
