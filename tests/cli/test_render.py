"""`render` as a user types it, on a real data set of a few images."""

from collections.abc import Callable
from pathlib import Path

import pytest

TINY = (
    "data.sensor_size=56",
    "data.f_range=[300,500]",
    "preset=smoke",
    "data.image_size=32",
    "data.n_train=3",
    "data.n_held_out=1",
    "data.n_test=2",
    "data.samples_per_pixel=1",
)


@pytest.fixture
def render(phd_exp: Callable) -> Callable:
    return lambda *arguments: phd_exp("render", *TINY, *arguments)


def test_render_prints_its_cost_and_verify_accepts_the_result(render: Callable) -> None:
    outcome = render("data=occl")
    assert outcome.status == 0, outcome.err
    assert "rendered 6 images in" in outcome.err
    assert "renders/occl: 4 training and 2 test samples are there" in outcome.out
    verified = render("data=occl", "verify=true", "rerender=2")
    assert verified.status == 0, verified.err
    assert "all 6 samples are as they were rendered" in verified.out


def test_verify_names_every_fault_and_render_repairs_it(render: Callable, phd_exp: Callable, tmp_path: Path) -> None:
    """The data set is rendered in shards; a shard that does not exist fails alone, and is named."""
    outcome = phd_exp("-m", "render", *TINY, "data=default", "shard=0/2,2/2,1/2")
    assert outcome.status == 2
    (error,) = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert "shard=2/2: shard: got '2/2'; expected INDEX/COUNT" in error
    images = tmp_path / "renders" / "default" / "train"
    whole = (images / "000002.png").read_bytes()
    (images / "000001.png").unlink()
    (images / "000002.png").write_bytes(b"nonsense")
    outcome = render("data=default", "verify=true", "rerender=0")
    assert outcome.status == 1
    complaints = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
    assert ["000001.png" in complaints[0], "000002.png" in complaints[1], len(complaints)] == [True, True, 2]
    (images / "000002.png").unlink()
    assert render("data=default").status == 0
    assert (images / "000002.png").read_bytes() == whole
    assert render("data=default", "verify=true").status == 0


def test_masks_are_written_to_the_given_folder(render: Callable, tmp_path: Path) -> None:
    outcome = render("data=scale", "masks=masks", "data.image_format=webp")
    assert outcome.status == 0, outcome.err
    assert "masks: 6 masks" in outcome.out
    assert sorted(path.name for path in (tmp_path / "masks" / "test").iterdir()) == ["000000.png", "000001.png"]
    refused = render("data=default", "masks=renders/default/masks")
    assert refused.status == 1
    assert refused.err.startswith("error: masks=renders/default/masks: lies in the data set itself")
    assert not (tmp_path / "renders" / "default").exists(), "refused before anything is rendered"


def test_verifying_a_missing_data_set_is_one_line(render: Callable) -> None:
    outcome = render("verify=true")
    assert outcome.status == 1
    assert outcome.err.startswith("error: ")
    assert "no data set here" in outcome.err
