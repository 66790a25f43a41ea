"""A rendered folder is read by other programmes as it is: Hugging Face `datasets`, and plain pandas."""

import importlib
import json
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas
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


def test_pandas_reads_it(folder: DatasetFolder) -> None:
    for split in SPLITS:
        records = folder.records(split)
        # without precise_float the last bit of a number may differ
        table = pandas.read_json(folder.metadata_path(split), lines=True, precise_float=True)
        assert list(table.columns) == list(SampleRecord.model_fields)
        for row, record in zip(table.to_dict("records"), records, strict=True):
            for key in ("file_name", "index", "split", "scene", "view", "sha256"):
                assert row[key] == getattr(record, key)
            for key in ("x", "y", "z", "f", "S", "scale", "visibility", "truncation"):
                assert math.isclose(row[key], getattr(record, key), rel_tol=1e-15)
