"""Processes that train one run together: started with one plain run each, watched, and ended together.

Lightning would start the command of this process again, which in a sweep is the whole sweep. Each process here is
`python -m phd_exp.training.rank`, whatever launcher runs the job, and hears of its run through a socket; that socket
ends with this process, however it dies, and then so does the other.
"""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any

from phd_exp.records.errors import RunError, UserError
from phd_exp.training.config import RunConfig
from phd_exp.training.recorder import Draw


@dataclass(frozen=True)
class Share:
    """What one process is told: the run, and which of how many it is."""

    config: RunConfig
    folder: Path
    draw: Draw | None
    threads: int
    rank: int


@dataclass(frozen=True)
class Report:
    """What a process says at its end: the results of the run, or what went wrong.

    Attributes:
        error: something that the user can mend.
        fault: the traceback of anything else.
    """

    results: dict[str, Any] | None = None
    error: UserError | None = None
    fault: str | None = None


class Rank:
    """One process; used as a context, it is gone at the end."""

    def __init__(self, share: Share, environment: Mapping[str, str]) -> None:
        self.name = f"process {share.rank} of {share.config.trainer.devices}"
        self.connection, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "phd_exp.training.rank", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **environment},
            )
        self.connection.send(share)

    def __enter__(self) -> "Rank":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._process.kill()
        self.connection.close()
        self._process.wait()

    def report(self) -> Report:
        """What it says. Raises the error or the fault of which it tells; RunError where it died without a word."""
        try:
            report: Report = self.connection.recv()
        except (EOFError, ConnectionResetError):
            raise RunError(self._obituary()) from None
        if report.error is not None:
            raise report.error
        if report.fault is not None:
            fault = RuntimeError(f"{self.name} failed with {report.fault.splitlines()[-1]}")
            fault.add_note(report.fault)
            raise fault
        return report

    def _obituary(self) -> str:
        code = self._process.wait()
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        return (
            f"{self.name} {how}; the others were ended, and the same command goes on from the last checkpoint"
        )


def train_together(config: RunConfig, folder: Path, draw: Draw | None, threads: int) -> dict[str, Any]:
    """Run one run with `trainer.devices` processes, each with its share of the threads; returns its results.

    Raises what the first process to fail says; the others are ended.
    """
    world = config.trainer.devices
    threads = max(1, threads // world)
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(_free_port()), "WORLD_SIZE": str(world)}
    with ExitStack() as stack:
        ranks = []
        for number in range(world):
            own = {"RANK": str(number), "LOCAL_RANK": str(number), "NODE_RANK": "0", "PYTHONPATH": _path()}
            share = Share(config, folder, draw, threads, number)
            ranks.append(stack.enter_context(Rank(share, shared | own)))
        reports = _all_reports(ranks)
    results = reports[0].results
    assert results is not None
    return results


def _all_reports(ranks: list[Rank]) -> list[Report]:
    """What the processes say, in their order. Raises what the first to fail says."""
    silent = {rank.connection: number for number, rank in enumerate(ranks)}
    reports: dict[int, Report] = {}
    while silent:
        for connection in wait(list(silent)):
            assert isinstance(connection, Connection)
            number = silent.pop(connection)
            reports[number] = ranks[number].report()
    return [reports[number] for number in range(len(ranks))]


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _path() -> str:
    """PYTHONPATH with this package's home, which need not be installed."""
    home = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")]))
