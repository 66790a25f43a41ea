"""What a training prints: soon how long it will take, and without a bar a line at least every half minute."""

import re
from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from phd_exp.records.processes import duration
from phd_exp.training import progress
from phd_exp.training.progress import BETWEEN_LINES, FIRST_LINE, Progress

BATCHES, EPOCHS = 100, 10


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[tuple[float, str]]]:
    """The lines of a training with batches of so many seconds, each with the time at which it is printed."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now.seconds)

    def train(seconds: float, bar: bool = False) -> list[tuple[float, str]]:
        lines: list[tuple[float, str]] = []
        now.seconds = 1000.0

        def keep(line: str) -> None:
            lines.append((now.seconds - 1000.0, line))

        callback = Progress(SimpleNamespace(print=keep) if bar else None)  # type: ignore[arg-type]
        callback.say = keep
        trainer: Any = SimpleNamespace(
            max_epochs=EPOCHS, num_training_batches=BATCHES, check_val_every_n_epoch=2,
            callback_metrics={"test/loss": 3.0},
        )  # fmt: skip
        callback.on_train_start(trainer, None)  # type: ignore[arg-type]
        for trainer.current_epoch in range(EPOCHS):
            for batch in range(BATCHES):
                now.seconds += seconds
                callback.on_train_batch_end(trainer, None, None, None, batch)  # type: ignore[arg-type]
            callback.on_train_epoch_end(trainer, None)  # type: ignore[arg-type]
        return lines

    return train


@pytest.mark.parametrize("seconds", [0.01, 0.7, 12.0])
def test_lines_come_early_and_often_and_say_what_is_left(trained: Callable, seconds: float) -> None:
    lines = trained(seconds)
    times = [0.0, *(time for time, _ in lines)]
    assert times[1] <= 2 * seconds + FIRST_LINE
    gaps = [after - before for before, after in pairwise(times)]
    assert max(gaps) <= max(BETWEEN_LINES, FIRST_LINE + seconds) + seconds
    epochs = [line for _, line in lines if re.match(r"epoch \d+/10:", line)]
    assert len(epochs) == EPOCHS
    assert ["test/loss 3" in line for line in epochs] == [False, True] * (EPOCHS // 2)
    for time, line in lines:
        left = EPOCHS * BATCHES * seconds - time
        assert any(line.endswith(f"about {duration(left + rounding)} left") for rounding in (-1e-6, 1e-6))


def test_with_a_bar_the_estimate_is_printed_once(trained: Callable) -> None:
    ((time, line),) = trained(36.0, bar=True)
    assert time == pytest.approx(72)
    assert line == "epoch 1/10, batch 2/100: about 10.0 h left"
