"""Renders of each variant, and the lines of their metadata."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.golden.compare import read
from tests.support.meshes import solid, write_mesh
from tests.support.untrained import read_metadata

SMALL = (
    "data.sensor_size=56", "data.f_range=[300,500]", "data.samples_per_pixel=4", "data.n_held_out=0", "data.n_test=1",
    "data.workers=1",
)  # fmt: skip
WORDS = {name: ("data.n_train=2",) for name in ("default", "occl", "scale", "occl_scale")}
WORDS["object"] = ("data.n_train=1", "data.xy_range=0.2", "data.distractors=1", "data.mesh={mesh}")


@pytest.mark.parametrize("variant", WORDS)
def test_renders_and_their_metadata(golden: Callable, phd_exp: Callable, tmp_path: Path, variant: str) -> None:
    mesh = write_mesh(tmp_path / "part.stl", solid("cylinder"))
    words = (word.format(mesh=mesh.name) for word in WORDS[variant])
    outcome = phd_exp("render", f"data={variant}", *SMALL, *words)
    assert outcome.status == 0, outcome.err
    made = {}
    for split in ("train", "test"):
        folder = tmp_path / "renders" / variant / split
        records = read_metadata(folder)
        made[f"{split}.jsonl"] = [
            {key: value for key, value in record.items() if key != "sha256"} for record in records
        ]
        for record in records:
            (folder / record["file_name"]).rename(picture := folder / f"{split}-{record['index']}.webp")
            made[picture.name] = read(picture)
    golden(f"pictures/{variant}", made)
