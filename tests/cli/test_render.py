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


def test_render_says_what_it_cost_and_verify_finds_it_sound(render: Callable) -> None:
    outcome = render("data=occl")
    assert outcome.status == 0, outcome.err
    assert "rendered 6 images in" in outcome.err
    assert "renders/occl: 4 training and 2 test samples are there" in outcome.out
    verified = render("data=occl", "verify=true", "rerender=2")
    assert verified.status == 0, verified.err
    assert "all 6 samples are as they were rendered" in verified.out


def test_verify_names_every_fault_and_render_mends_it(render: Callable, tmp_path: Path) -> None:
    render("data=default")
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


def test_masks_lie_where_they_are_asked_for(render: Callable, tmp_path: Path) -> None:
    outcome = render("data=scale", "masks=masks", "data.image_format=webp")
    assert outcome.status == 0, outcome.err
    assert "masks: 6 masks" in outcome.out
    assert sorted(path.name for path in (tmp_path / "masks" / "test").iterdir()) == [
        "000000.png",
        "000001.png",
    ]
    refused = render("data=default", "masks=renders/default/masks")
    assert refused.status == 1
    assert refused.err.startswith("error: masks=renders/default/masks: lies in the data set itself")
    assert not (tmp_path / "renders" / "default").exists(), "refused before anything is rendered"


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("verify=perhaps", "verify: got 'perhaps'"),
        ("rerender=-1", "rerender: got -1"),
        ("masks=true", "masks: got True; expected the name of a folder"),
        ("data.image_format=gif", "data.image_format: got 'gif'"),
        ("data.image_quality=0", "data.image_quality: got 0"),
        ("data.views=0", "data.views: got 0"),
        ("data.view_angle_range=[60,20]", "data.view_angle_range: "),
    ],
)
def test_bad_values_are_one_line(render: Callable, tmp_path: Path, argument: str, said: str) -> None:
    outcome = render(argument)
    assert outcome.status == 2
    (line,) = outcome.err.splitlines()
    assert line.startswith(f"error: {said}")
    assert list(tmp_path.iterdir()) == []


def test_verifying_nothing_is_one_line(render: Callable) -> None:
    outcome = render("verify=true")
    assert outcome.status == 1
    assert outcome.err.startswith("error: ")
    assert "no data set here" in outcome.err
