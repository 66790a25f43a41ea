"""What a training prints: one bar on a terminal; elsewhere a line soon, and then about every tenth of the run."""

import math
import os
import pty
import re
import sys
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TextIO

import pytest

from phd_exp.records.processes import duration
from phd_exp.training import progress
from phd_exp.training.progress import FEWEST, LINES, LONG, LONGEST, PATIENCE, Progress, line_epochs

BATCHES = 100


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[tuple[float, str]]]:
    """The lines of a training with batches of so many seconds, each with the time at which it is printed."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now.seconds)

    def train(seconds: Any, epochs: int, every: int, preset: str = "") -> list[tuple[float, str]]:
        lines: list[tuple[float, str]] = []
        now.seconds = 1000.0
        callback = Progress(False, preset)
        callback.say = lambda line: lines.append((now.seconds - 1000.0, line))  # type: ignore[assignment]
        trainer: Any = SimpleNamespace(
            max_epochs=epochs, num_training_batches=BATCHES, check_val_every_n_epoch=every, current_epoch=0,
            callback_metrics={"train/loss": 4.0, "test/loss": 3.0},
        )  # fmt: skip
        callback.on_train_start(trainer, None)  # type: ignore[arg-type]
        for trainer.current_epoch in range(epochs):
            for batch in range(BATCHES):
                now.seconds += seconds(trainer.current_epoch * BATCHES + batch) if callable(seconds) else seconds
                callback.on_train_batch_end(trainer, None, {"loss": 5.0}, None, batch)  # type: ignore[arg-type]
            callback.on_train_epoch_end(trainer, None)  # type: ignore[arg-type]
        return lines

    return train


@pytest.mark.parametrize("seconds", [0.01, 0.7, 12.0])
@pytest.mark.parametrize(("epochs", "every"), [(1, 1), (2, 1), (10, 1), (42, 10), (90, 1), (90, 45)])
def test_lines_come_soon_and_about_every_tenth(trained: Callable, seconds: float, epochs: int, every: int) -> None:
    lines, whole = trained(seconds, epochs, every), epochs * BATCHES * seconds
    times = [0.0, *(time for time, _ in lines)]
    assert min(LINES, epochs) <= len(lines) <= 2 * LINES
    soon = min(FEWEST * seconds, LONGEST) + 2 * seconds + PATIENCE
    assert times[1] <= max(soon, whole / LINES if whole < 2 * PATIENCE else 0) + seconds
    assert max(after - before for before, after in pairwise(times)) <= max(
        0.2 * whole, whole / epochs if whole < 60 else 0
    )
    for time, line in lines:
        left = whole - time
        assert any(line.endswith(f"about {duration(left + rounding)} left") for rounding in (-1e-6, 1e-6))
    for _, line in lines:
        number, batch, tested = re.match(
            rf"epoch (\d+)/{epochs}(, batch \d+/\d+)?: (test/loss 3|loss 5)?", line
        ).groups()  # type: ignore[union-attr]
        expected = "test/loss 3" if int(number) % every == 0 else "loss 5"
        assert tested == (None if batch else expected)


def test_slow_first_batches_do_not_count_for_long(trained: Callable) -> None:
    """Ten times as slow until the sixth: within a factor of two from the first line."""
    lines = trained(lambda number: 5.0 if number < 6 else 0.5, 20, 20)
    whole = 6 * 5.0 + (20 * BATCHES - 6) * 0.5
    for time, line in lines:
        minutes = float(re.search(r"about (\d+) min", line)[1]) if "min" in line else None  # type: ignore[index]
        assert minutes is None or 0.5 < 60 * minutes / (whole - time) < 2


@pytest.mark.parametrize(("preset", "smaller"), [("full", "preset=small"), ("small", "preset=demo"), ("demo", "")])
@pytest.mark.parametrize("seconds", [0.05, 1.0])
def test_a_long_training_names_a_smaller_one_once(
    trained: Callable, seconds: float, preset: str, smaller: str
) -> None:
    is_long = 20 * BATCHES * seconds > LONG
    named = [line for _, line in trained(seconds, 20, 20, preset) if "preset=" in line]
    assert len(named) == int(is_long and bool(smaller))
    assert all(re.fullmatch(rf"about .* left; {smaller} takes a fraction of it", line) for line in named)


@pytest.mark.parametrize(("epochs", "every"), [(1, 1), (7, 2), (10, 10), (42, 10), (90, 1), (1000, 7)])
def test_at_most_ten_epochs_have_a_line_and_most_of_them_are_evaluated(epochs: int, every: int) -> None:
    found = line_epochs(epochs, every)
    assert len(found) == min(LINES, epochs)
    assert max(found) == epochs or max(found) % every == 0
    tested = math.floor(epochs / every)
    assert sum(epoch % every == 0 for epoch in found) >= min(tested, LINES // 2)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[TextIO, Callable[[], str]]]:
    """A pseudo-terminal, and what it has received; pytest would replace it as standard error before the test."""
    ours, theirs = pty.openpty()
    received = bytearray()

    def read() -> None:
        while True:
            try:
                part = os.read(ours, 4096)
            except OSError:  # closed
                return
            received.extend(part)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    for name, value in (("TERM", "xterm"), ("COLUMNS", "100")):
        monkeypatch.setenv(name, value)
    stream = os.fdopen(theirs, "w")

    def text() -> str:
        stream.flush()
        stream.close()
        reader.join(timeout=10)
        return received.decode()

    yield stream, text
    os.close(ours)


def test_a_terminal_shows_one_bar_with_loss_errors_and_the_time_left(
    run_in: Callable,
    terminal: tuple[TextIO, Callable[[], str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Any,
) -> None:
    stream, received = terminal
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "BETWEEN_LOOKS", 0.0)
    run_in(tmp_path, "model=mae_vz", "trainer.max_epochs=2", "trainer.progress_bar=true", "data.batch_size=4")
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", received())
    assert "\u2501" in text, "a bar"
    for number in (1, 2):
        assert re.search(rf"epoch {number}/2 .* about \d+ s left, loss \d", text), text
    assert re.search(r"epoch 2/2 .* about 0 s left, loss [\d.e-]+, test errors [\d.e+]+ and [\d.e+]+ mm", text)
    assert not re.search(r"Predicting|Validation|Epoch 0|epoch 0/|it/s", text)
    assert "epoch" not in capsys.readouterr().out, "no lines beside the bar"
