"""`render` as a user types it, on a real data set of a few images."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.meshes import solid, write_mesh

TINY = (
    "data.sensor_size=56", "data.f_range=[300,500]", "preset=smoke", "data.image_size=32", "data.n_train=3",
    "data.n_held_out=1", "data.n_test=2", "data.samples_per_pixel=1",
)  # fmt: skip


@pytest.fixture
def render(phd_exp: Callable) -> Callable:
    return lambda *arguments: phd_exp("render", *TINY, *arguments)


@pytest.mark.slow
def test_a_data_set_is_rendered_in_shards_and_verified_and_repaired(
    render: Callable, phd_exp: Callable, tmp_path: Path
) -> None:
    """A shard that does not exist fails alone, and is named; each fault is named, and what is sound stays."""
    outcome = phd_exp("-m", "render", *TINY, "shard=0/2,2/2,1/2")
    assert outcome.status == 2
    (error,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "shard=2/2: shard: got '2/2'; expected INDEX/COUNT" in error
    verified = render("verify=true", "rerender=2")
    assert verified.status == 0, verified.err
    assert "all 6 samples are as they were rendered" in verified.out

    images = tmp_path / "renders" / "default" / "train"
    whole = (images / "000002.png").read_bytes()
    (images / "000001.png").unlink()
    (images / "000002.png").write_bytes(b"nonsense")
    outcome = render("verify=true", "rerender=0")
    assert outcome.status == 1
    complaints = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert ["000001.png" in complaints[0], "000002.png" in complaints[1], len(complaints)] == [True, True, 2]

    (images / "000002.png").unlink()
    repaired = render("masks=masks", "bop=bop")
    assert repaired.status == 0, repaired.err
    assert "rendered 2 images in" in repaired.err
    assert "renders/default: 4 training and 2 test samples are there" in repaired.out
    assert (images / "000002.png").read_bytes() == whole
    assert "masks: 6 masks" in repaired.out
    assert {path.name for path in (tmp_path / "masks" / "test").iterdir()} == {"000000.png", "000001.png"}
    assert "bop: 6 images as BOP" in repaired.out
    assert (tmp_path / "bop" / "train" / "000000" / "rgb" / "000002.png").read_bytes() == whole


@pytest.mark.slow
def test_all_that_a_training_reads_is_rendered(render: Callable, phd_exp: Callable, tmp_path: Path) -> None:
    """Machines that train may lack Blender."""
    write_mesh(tmp_path / "part.stl", solid("cube"))
    words = ("data=object", "data.mesh=part.stl", "data.backdrops=null", "recipe=strong")
    outcome = render(*words, "recipe.augmentation.backdrops=0.5")
    assert outcome.status == 0, outcome.err
    names = {"object": (4, 2), "object-backdrops": (3, 0)}
    for name, counts in names.items():
        folder = tmp_path / "renders" / name
        assert tuple(len(list((folder / split).glob("*.png"))) for split in ("train", "test")) == counts
