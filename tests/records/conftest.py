"""A data set folder that took no renderer: real scenes, one-colour images."""

import io
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder, Manifest, Seal, sha256
from phd_exp.records.files import write_atomic
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import trace_pixels
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.worker import describe


@pytest.fixture
def dataset(tmp_path: Path, make_spec: Callable[..., DatasetSpec]) -> DatasetFolder:
    """Five training and two test samples."""
    folder, spec = DatasetFolder(tmp_path / "default"), make_spec()
    counts: dict[Split, int] = {"train": 5, "test": 2}
    seals = {split: _fill(folder, spec, split, n) for split, n in counts.items()}
    folder.write_manifest(Manifest(generator=1, renderer="none", spec=spec, splits=seals))
    return folder


def _fill(folder: DatasetFolder, spec: DatasetSpec, split: Split, n: int) -> Seal:
    folder.split_folder(split).mkdir(parents=True)
    records = [_sample(folder, spec, split, index) for index in range(n)]
    text = "".join(record.model_dump_json() + "\n" for record in records)
    write_atomic(folder.metadata_path(split), text)
    return Seal(n=n, metadata_sha256=sha256(text.encode()))


def _sample(folder: DatasetFolder, spec: DatasetSpec, split: Split, index: int) -> SampleRecord:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8), (index, 0, 0)).save(stream, format="PNG")
    write_atomic(folder.image_path(split, index), stream.getvalue())
    scene = sample_scene(spec, split, index)
    return describe(spec, split, index, scene, trace_pixels(scene), sha256(stream.getvalue()))
