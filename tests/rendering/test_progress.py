"""Progress in a log file: a line now and then, and one at the end; a forecast as soon as the speed is known."""

import re
from collections.abc import Iterable

import pytest

from phd_exp.rendering import progress
from phd_exp.rendering.progress import LONG, shown_progress


@pytest.fixture
def advanced(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """What is printed while images are done at these seconds, of n images."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[-1])

    def lines(moments: Iterable[float], n: int, remedy: str = "") -> list[str]:
        with shown_progress(n, "rendering default", remedy) as advance:
            for moment in moments:
                now.append(moment)
                advance()
        return capsys.readouterr().err.splitlines()

    return lines


def test_lines_come_every_ten_seconds_and_at_the_end(advanced) -> None:
    lines = advanced((60.0 + 2 * image for image in range(20)), 20)
    counts = [int(re.match(r"rendering default: (\d+)/20 images, 0\.5 images/s", line)[1]) for line in lines]
    assert counts == [8, 13, 18, 20]
    assert "about 24 s left" in lines[0]
    assert "left" not in lines[-1]
    assert advanced([200.0], 1) == ["rendering default: 1/1 images"], "too few to measure a speed"


@pytest.mark.parametrize("processes", [1, 2, 8])
@pytest.mark.parametrize("seconds", [0.02, 2.0, 9.0])
def test_the_first_forecast_is_right_within_a_factor_of_two(advanced, processes: int, seconds: float) -> None:
    """Blender starts for 60 s, the first image of each process takes five times as long, images vary by a half."""
    n = 5_000_000
    starts = [60.0 + 5 * seconds + 0.01 * worker for worker in range(processes)]
    moments = sorted(
        start + seconds * (image + (image * 0.618 + worker * 0.3) % 1 / 2)
        for worker, start in enumerate(starts)
        for image in range(400)
    )
    long, *_ = (line for line in advanced(moments, n, "fewer images") if "fewer images" in line)
    left = float(re.match(r"about ([\d.]+) h left; fewer images$", long)[1]) * 3600
    assert n * seconds / processes / 2 < left < 2 * n * seconds / processes
    assert left > LONG
    assert not any("fewer" in line for line in advanced(moments[:20], 20, "fewer images"))
