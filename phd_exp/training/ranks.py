"""Training one run with several processes, which end together.

Lightning would start the command of this process again, which in a sweep is the whole sweep. Here each process is
`python -m phd_exp.training.ranks DESCRIPTOR`, whatever launcher runs the job. It receives its run through a socket
that closes when this process ends, however it ends; the process then exits too.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any

import torch.distributed as dist

from phd_exp.records.errors import RunError, UserError
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RunConfig
from phd_exp.training.recorder import Draw

Share = tuple[RunConfig, Path, Draw | None, int, int]
"""The task of one process: the run, its folder, how curves are drawn, the number of threads, and the rank."""


class Rank:
    """One process; as a context, it has ended on exit."""

    def __init__(self, share: Share, environment: Mapping[str, str]) -> None:
        config, *_, rank = share
        self.name = f"process {rank} of {config.trainer.devices}"
        self.connection, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "phd_exp.training.ranks", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **environment, "RANK": str(rank), "LOCAL_RANK": str(rank)},
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

    def results(self) -> dict[str, Any]:
        """The results of the run. Raises the error of the process; RunError if it died without one."""
        try:
            outcome = self.connection.recv()
        except (EOFError, ConnectionResetError):
            code = self._process.wait()
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
            raise RunError(
                f"{self.name} {how}; the others were ended, and the same command goes on from the last checkpoint"
            ) from None
        if isinstance(outcome, Exception):
            raise outcome
        results: dict[str, Any] = outcome
        return results


def train_together(config: RunConfig, folder: Path, draw: Draw | None, threads: int) -> dict[str, Any]:
    """Train one run with `trainer.devices` processes, which share the threads; returns its results.

    Raises the error of the first process to fail; the others are ended.
    """
    world = config.trainer.devices
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    home = str(Path(__file__).resolve().parents[2])  # the package need not be installed
    environment = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "WORLD_SIZE": str(world),
        "NODE_RANK": "0",
        "PYTHONPATH": os.pathsep.join(filter(None, [home, os.environ.get("PYTHONPATH")])),
    }
    with ExitStack() as stack:
        ranks: dict[Any, Rank] = {}
        for number in range(world):
            share = (config, folder, draw, max(1, threads // world), number)
            rank = stack.enter_context(Rank(share, environment))
            ranks[rank.connection] = rank
        first, results = next(iter(ranks)), {}
        while ranks:
            for connection in wait(list(ranks)):
                results[connection] = ranks.pop(connection).results()
    return results[first]


def take_share(descriptor: int) -> None:
    """In a process started by `Rank`: train, and send back the results or the error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent decides
    connection = Connection(descriptor)
    share: Share = connection.recv()
    threading.Thread(target=_exit_with_parent, args=(connection,), daemon=True).start()
    connection.send(_outcome(share))
    if dist.is_initialized():
        dist.destroy_process_group()


def _outcome(share: Share) -> dict[str, Any] | Exception:
    from phd_exp.training.run import run  # it imports this module

    config, folder, draw, threads, rank = share
    try:
        return run(config, RunFolder(folder), draw, threads, rank)
    except UserError as error:
        return error
    except Exception as error:  # it may not pickle, its traceback does
        last = traceback.format_exception_only(error)[-1].strip()
        fault = RuntimeError(f"process {rank} of {config.trainer.devices} failed with {last}")
        fault.add_note(traceback.format_exc())
        return fault


def _exit_with_parent(connection: Connection) -> None:
    """Exit at once when the connection closes; nothing else arrives through it."""
    with suppress(EOFError, OSError):
        connection.recv()
    os._exit(1)


if __name__ == "__main__":
    from phd_exp.training import ranks  # under its own name, so that the objects sent can be unpickled

    ranks.take_share(int(sys.argv[1]))
