"""A small data set made without a renderer: noise as images, known positions."""

import io
from collections.abc import Callable, Mapping

import numpy as np
from PIL import Image

from phd_exp.records.dataset import DatasetFolder, Manifest, Seal, image_name, sha256
from phd_exp.records.scenes import FIRST_VIEW, Backdrop, SampleRecord, SceneObject, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.masks import ensure_drawn

SIDE = 64


def picture(index: int, side: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (side, side, 3), dtype=np.uint8)


def record(split: Split, index: int, content: bytes) -> SampleRecord:
    position = (0.01 * index, -0.01 * index, 3.5 + 0.1 * index)
    cylinder = SceneObject(
        shape="cylinder",
        position=position,
        rotation=(1.0, 0.0, 0.0, 0.0),
        dimensions=(0.2, 0.2, 0.2),
        scale=1.0,
        colour=(1.0, 0.0, 0.0),
        material="rubber",
    )
    return SampleRecord(
        file_name=image_name(index),
        x=position[0],
        y=position[1],
        z=position[2],
        f=450.0 + index,
        S=SIDE,
        scale=1.0,
        visibility=1.0,
        truncation=0.0,
        index=index,
        split=split,
        seed=0,
        scene=index,
        view=0,
        pose=FIRST_VIEW,
        objects=(cylinder,),
        lamps=(),
        backdrop=Backdrop(level=0.5, falloff=0.0, centre=(0.5, 0.5)),
        noise_seed=0,
        sha256=sha256(content),
    )


Recorded = Callable[[Split, int, bytes], SampleRecord]
"""Split, index and image file of a sample -> its record."""


def write_handmade(folder: DatasetFolder, spec: DatasetSpec, counts: Mapping[Split, int]) -> DatasetFolder:
    """Write a sealed data set of so many samples per split."""
    write_sealed(folder, spec, counts, record, SIDE)
    ensure_drawn(folder, spec, counts.get("train", 0))
    return folder


def write_sealed(
    folder: DatasetFolder, spec: DatasetSpec, counts: Mapping[Split, int], recorded: Recorded, side: int
) -> DatasetFolder:
    """Write a sealed data set of the `recorded` samples, without masks."""
    seals = {}
    for split, n in counts.items():
        folder.split_folder(split).mkdir(parents=True)
        lines = ""
        for index in range(n):
            buffer = io.BytesIO()
            Image.fromarray(picture(index, side)).save(buffer, spec.image_format)
            folder.image_path(split, index, spec.image_format).write_bytes(buffer.getvalue())
            lines += recorded(split, index, buffer.getvalue()).model_dump_json() + "\n"
        folder.metadata_path(split).write_text(lines)
        seals[split] = Seal(n=n, metadata_sha256=sha256(lines.encode()))
    folder.write_manifest(Manifest(generator=1, renderer="none", spec=spec, splits=seals))
    return folder
