"""Progress in a log file: a line now and then, and one at the end; no time before it can be measured."""

from collections.abc import Iterable

import pytest

from phd_exp.rendering import progress
from phd_exp.rendering.progress import FEWEST, PATIENCE, Forecast, shown_progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that progress reads; its last value is now."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[-1])
    return now


def advanced(clock: list[float], times: Iterable[float], n: int, **options: object) -> None:
    with shown_progress(n, "rendering default", **options) as advance:  # type: ignore[arg-type]
        for moment in times:
            clock.append(moment)
            advance()


def test_lines_come_every_ten_seconds_and_at_the_end(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    advanced(clock, range(4, 28, 4), 6)
    assert capsys.readouterr().err.splitlines() == [
        "rendering default: 4/6 images, 0.2 images/s, about 8 s left",
        "rendering default: 6/6 images, 0.2 images/s",
    ]


@pytest.mark.parametrize("processes", [1, 2, 8])
@pytest.mark.parametrize("seconds", [0.02, 2.0, 9.0])
def test_the_forecast_is_right_within_a_factor_of_two(clock: list[float], processes: int, seconds: float) -> None:
    """Blender starts for 60 s, the first image of each process takes five times as long, images vary by a half."""
    n, moments = 4000, []
    for worker in range(processes):
        moment = 60.0 + 5 * seconds + 0.01 * worker
        for image in range(n // processes):
            moments.append(moment)
            moment += seconds * (0.5 + (image * 0.618 + worker * 0.3) % 1)
    moments.sort()
    forecast, forecasts = Forecast(n, processes), 0
    for moment in moments:
        clock.append(moment)
        forecast.count()
        truth = moments[-1] - moment
        if forecast.left is not None and truth > 10 * seconds:
            forecasts += 1
            assert truth / 2 < forecast.left < 2 * truth
        early = forecast.done < (1 + FEWEST) * processes or moment < moments[processes - 1] + PATIENCE
        assert (forecast.left is None) == early or forecast.done == n
    assert forecasts > 100


def test_a_long_render_names_the_smaller_choice_once(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    advanced(clock, (60.0 + 2 * image for image in range(12)), 4000, remedy="fewer images: preset=demo")
    text = capsys.readouterr().err
    assert text.count("about 2.2 h left; fewer images: preset=demo") == 1
    advanced(clock, (60.0 + 2 * image for image in range(12)), 100, remedy="fewer images: preset=demo")
    assert "preset=demo" not in capsys.readouterr().err
