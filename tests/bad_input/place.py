"""What bad inputs are made from: a sound run, sound images and a sound data set, made without a renderer."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from phd_exp.__main__ import main
from phd_exp.cli.jobs import composed
from phd_exp.records.dataset import SPLITS, DatasetFolder, Seal, sha256
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import write_handmade
from tests.support.untrained import NARROW, write_metadata

TRAIN = (
    "preset=smoke", "logger=none", "data=folder", "data.batch_size=4", "data.image_size=32", "data.n_held_out=0",
    "trainer.threads=1", "trainer.precision=float32", "trainer.progress_bar=false", "trainer.max_epochs=1",
    "trainer.accelerator=cpu", *NARROW,
)  # fmt: skip
HANDMADE = ("preset=smoke", "data.variant=handmade", "data.sensor_size=64", "data.f_range=[400,600]")
PREDICT = ("predict", "run=RUN", "folder=photos/test")
ONE = ("predict", "run=RUN", "image=photos/test/0.png", "f=300")
REPORT = ("report", "runs=runs")
LEARN = (*TRAIN, "data.folder=photos")
VERIFY = ("render", *HANDMADE, "verify=true", "rerender=0")


@dataclass(frozen=True)
class Place:
    """A folder of one test: `photos/`, `renders/handmade/`, `runs/` with one run; where the command is given."""

    root: Path

    @property
    def run(self) -> RunFolder:
        (path,) = self.root.glob("runs/smoke/folder/probabilistic/seed0-*")
        return RunFolder(path)

    def named(self, word: str) -> str:
        """A word in which RUN stands for the run, whose name holds a hash."""
        return word.replace("RUN", str(self.run.path.relative_to(self.root)))

    def put(self, file: Path | str, content: bytes | str) -> None:
        """Write a file anew, whatever is there."""
        path = self.root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(content.encode(errors="surrogateescape") if isinstance(content, str) else content)

    @property
    def handmade(self) -> DatasetFolder:
        return DatasetFolder(self.root / "renders/handmade")

    def put_record(self, image: bytes | None = None, **changes: Any) -> None:
        """Change the first line of the handmade test split, and its image, as somebody who knows the format."""
        folder = self.handmade
        if image is not None:
            folder.image_path("test", 0).write_bytes(image)
            changes["sha256"] = sha256(image)
        first, *rest = folder.metadata_path("test").read_text().splitlines()
        text = "\n".join([json.dumps(json.loads(first) | changes), *rest]) + "\n"
        folder.metadata_path("test").write_text(text)
        seals = folder.manifest.splits | {"test": Seal(n=2, metadata_sha256=sha256(text.encode()))}
        folder.write_manifest(folder.manifest.model_copy(update={"splits": seals}))

    def put_config(self, **changes: Any) -> None:
        """Change sections of the run's configuration."""
        self.put(self.run.config_file, yaml.safe_dump(self.run.config() | changes))

    def put_json(self, file: Path, **changes: Any) -> None:
        self.put(file, json.dumps(json.loads(file.read_text()) | changes))

    def put_checkpoint(self, **changes: Any) -> None:
        spoil_checkpoint(self.run.last_checkpoint, **changes)


def spoil_checkpoint(file: Path, **changes: Any) -> None:
    """Change what a checkpoint says."""
    torch.save(torch.load(file, weights_only=True) | changes, file)


def write_photos(folder: Path) -> None:
    """Noise with boxes anywhere, and true positions that project into the boxes."""
    draw = np.random.default_rng(0)
    for split, n in (("train", 6), ("test", 3)):
        (folder / split).mkdir(parents=True)
        lines = []
        for index in range(n):
            noise = draw.integers(0, 256, (90, 120, 3), dtype=np.uint8)
            Image.fromarray(noise).save(folder / split / f"{index}.png")
            line = {"file_name": f"{index}.png", "f": 300.0, "box": [10 + index, 10, 60, 70]}
            lines.append(line | {"x": -0.2, "y": -0.02, "z": 3.0 + 0.1 * index})
        write_metadata(folder / split, lines)


def make(root: Path) -> None:
    """Everything sound; the run is trained for one epoch."""
    write_photos(root / "photos")
    data = composed(HANDMADE)["data"]
    spec = DatasetSpec(**{key: value for key, value in data.items() if key in DatasetSpec.model_fields})
    write_handmade(DatasetFolder(root / "renders/handmade"), spec, dict.fromkeys(SPLITS, 2))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setattr("sys.argv", ["phd_exp"])
        assert main(list(LEARN)) == 0


def copied(sound: Path, root: Path) -> Place:
    """A copy to be spoiled."""
    return Place(Path(shutil.copytree(sound, root, dirs_exist_ok=True)))
