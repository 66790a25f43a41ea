"""Progress in a log file: a line now and then, and one at the end."""

import pytest

from phd_exp.rendering import progress
from phd_exp.rendering.progress import shown_progress


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
