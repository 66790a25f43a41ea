"""How errors and the end of a parent end a job; no job runs here."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from phd_exp.__main__ import main
from phd_exp.cli.frame import Stopped, ending_with, failure, stopping_on_signals

WORKER = """
import time
from phd_exp.cli.frame import Stopped, ending_with, stopping_on_signals
try:
    with stopping_on_signals(), ending_with(parent=-1):  # no parent of ours
        time.sleep(60)
except Stopped as stop:
    print(stop, flush=True)
    time.sleep(60)  # for further jobs
"""


def test_a_job_and_its_worker_end_with_the_process_that_started_them() -> None:
    done = subprocess.run([sys.executable, "-c", WORKER], capture_output=True, text=True, timeout=50, check=False)
    assert done.returncode == 128 + signal.SIGTERM
    with stopping_on_signals(), ending_with(os.getppid()):
        time.sleep(0.1)


def test_a_signal_is_acknowledged_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Stopped), stopping_on_signals():
        signal.raise_signal(signal.SIGINT)
    assert capfd.readouterr().err == "SIGINT received: stopping\n"


def test_without_standard_error_nothing_else_is_printed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", None)  # as with `2>&-`
    assert main(["trian"]) == 2
    sys.stderr.close()
    assert capsys.readouterr().out == ""


def test_memory_that_runs_out_is_one_line() -> None:
    with pytest.raises(RuntimeError) as caught:
        torch.empty(1 << 50)
    for error in (caught.value, MemoryError(), torch.OutOfMemoryError()):
        ending = failure(error)
        assert (ending.state, ending.exit_status) == ("failed", 1)
        (line,) = ending.lines
        assert line.startswith("memory ran out; free some, and the same command resumes, or lower data.batch_size")
