"""What a training prints: Lightning's bar on a terminal; elsewhere a line soon, then about every tenth of the run."""

import os
import pty
import re
import sys
import termios
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from phd_exp.config import check
from phd_exp.records.runs import RunFolder
from phd_exp.training import progress
from phd_exp.training.progress import LINES, Progress
from phd_exp.training.recorder import Recorder
from phd_exp.training.trainer import build_trainer

BATCHES, SECONDS = 20, 3.0


@pytest.mark.parametrize(("epochs", "every"), [(1, 1), (7, 2), (42, 10), (90, 45)])
def test_lines_state_the_time_left_and_the_last_errors(
    epochs: int, every: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a first batch that takes a hundred times as long, which spoils no estimate."""
    now = SimpleNamespace(seconds=1000.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: now.seconds)
    callback, total = Progress(), epochs * BATCHES
    trainer: Any = SimpleNamespace(
        max_epochs=epochs, num_training_batches=BATCHES, estimated_stepping_batches=total, current_epoch=0,
        global_step=0, callback_metrics={}, is_global_zero=True,
    )  # fmt: skip
    callback.setup(trainer, None, "fit")  # type: ignore[arg-type]
    callback.on_train_start(trainer, None)  # type: ignore[arg-type]
    for trainer.current_epoch in range(epochs):
        callback.on_train_epoch_start(trainer)
        for batch in range(BATCHES):
            now.seconds += SECONDS * (1 if trainer.global_step else 100)
            trainer.global_step += 1
            callback.on_train_batch_end(trainer, None, {"loss": 5.0}, None, batch)  # type: ignore[arg-type]
        if (trainer.current_epoch + 1) % every == 0:
            trainer.callback_metrics = {"test/depth_error_mm": float(trainer.current_epoch + 1)}
        callback.on_train_epoch_end(trainer, None)  # type: ignore[arg-type]
    soon, *lines = capsys.readouterr().out.splitlines()
    assert soon == f"epoch 1/{epochs}: left {progress.duration(SECONDS * (total - 10))}, loss 5"
    assert len(lines) == min(LINES, epochs)
    for line in lines:
        epoch, left, tested = re.fullmatch(  # type: ignore[union-attr]
            rf"epoch (\d+)/{epochs}: left (.*), loss 5(?:, test/depth_error_mm (\d+))?", line
        ).groups()
        assert left == progress.duration(SECONDS * BATCHES * (epochs - int(epoch)))
        assert int(tested or 0) == int(epoch) // every * every


def test_a_terminal_shows_a_bar_with_loss_errors_and_the_time_left(
    run_in: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(ours, (24, 200))
    received = bytearray()

    def read() -> None:
        while True:
            try:
                received.extend(os.read(ours, 4096))
            except OSError:  # closed
                return

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    monkeypatch.setattr(progress, "BETWEEN_LOOKS", 0.0)
    with os.fdopen(theirs, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        run_in(tmp_path, "model=mae_vz", "trainer.max_epochs=2", "trainer.progress_bar=true", "data.batch_size=4")
    reader.join(timeout=10)
    os.close(ours)
    text = received.decode()
    for number in (1, 2):
        assert re.search(rf"epoch {number}/2: .*\d/4 .*left=\d+ s, loss=\d", text), text
    assert re.search(r"epoch 2/2: .*4/4 .*left=0 s, loss=.*, test/projected_error_mm=.*, test/depth_error_mm=", text)


@pytest.mark.parametrize(("words", "expected"), [((), Progress), (("trainer.progress_bar=false",), None)])
def test_the_bar_is_left_out_on_request(
    composed: Callable, tmp_path: Path, words: tuple[str, ...], expected: type | None
) -> None:
    config = check(composed("preset=smoke", "trainer=cpu", *words))
    trainer = build_trainer(config, Recorder(RunFolder(tmp_path), config.evaluation, None, []))
    assert type(trainer.progress_bar_callback) is (expected or type(None))
