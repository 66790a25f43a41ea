"""Progress in a log file: a line now and then, and one at the end; no time before it can be measured."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import progress
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.render import _first_words


def test_lines_come_every_ten_seconds_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 1000, 4))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    with shown_progress(6, "rendering default") as advance:
        for _ in range(6):
            advance()
    assert capsys.readouterr().err.splitlines() == [
        "rendering default: 3/6 images, 0.2 images/s, 12 s left",
        "rendering default: 6/6 images, 0.2 images/s, 0 s left",
    ]


def test_the_forecast_follows_from_images_and_not_from_the_start(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Blender starts for 60 s, then each image takes 2 s."""
    times = [0.0, *(60.0 + 2 * image for image in range(12))]
    clock = iter(times)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with shown_progress(12, "rendering default") as advance:
        for _ in range(12):
            advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "rendering default: 2/12 images, 0.5 images/s, 20 s left"
    for line in lines:
        done, left = map(int, re.search(r": (\d+)/12 images, 0\.5 images/s, (\d+) s left", line).groups())  # type: ignore[union-attr]
        assert left == 2 * (12 - done)


@pytest.mark.parametrize("variant", ["default", "occl_scale"])
def test_no_time_is_promised_before_an_image_is_measured(make_spec: Callable[..., DatasetSpec], variant: str) -> None:
    for resumed in (False, True):
        words = _first_words(DatasetFolder(Path("x")), make_spec(variant), 4200, 2, resumed=resumed)
        assert "4200 images" in words
        assert not re.search(r"\d+(\.\d)? (s|min|h)\b", words)
