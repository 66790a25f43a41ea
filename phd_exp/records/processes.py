"""Processes that work together: locks on files, child processes, and lines for the person who waits."""

import fcntl
import os
import platform
import random
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from phd_exp.records.errors import one_line

PROJECT = Path(__file__).resolve().parents[2]
PATIENCE = 10.0  # seconds that a child gets to finish its work before it is killed


@contextmanager
def held(path: Path, *, waiting: str | None = None) -> Iterator[bool]:
    """Hold a lock in the body; yields whether it is held.

    If the lock is taken, `waiting` is printed and the lock awaited; without `waiting`, False is yielded at once.

    The lock is an `flock`: the system releases it when its process dies, on one machine or on several that share a
    file system. An NFS server must support locks (NFS 4 does); Lustre needs the mount option `flock`.

    Raises:
        OSError: the file cannot be opened for writing, or is a link, whose target may belong to someone else.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder, held(Path(folder, "lock")) as first:
        ...     with held(Path(folder, "lock")) as second:
        ...         print(first, second)
        True False
    """
    # NFS requires write access
    with open(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), "rb") as stream:
        free = True
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = waiting is not None
            if waiting is not None:
                announce(waiting)
                fcntl.flock(stream, fcntl.LOCK_EX)
        yield free


class Child:
    """A process that runs `python -m MODULE`, connected to this one; a context at whose end the process has ended.

    The module's main function begins with `parent()`. Unlike a `multiprocessing` child, the process imports nothing
    of the caller's main module, so that it works from scripts, notebooks and tests alike. The connection closes when
    its parent dies, however it dies.

    Args:
        module: the module to run.
        environment: variables that are set in addition to this process's.
        log: file to which the process's standard output and error are appended; by default they are those of this
            process.
    """

    def __init__(self, module: str, environment: Mapping[str, str] | None = None, log: Path | None = None) -> None:
        self.connection, theirs = Pipe()
        importable = os.pathsep.join(filter(None, [str(PROJECT), os.environ.get("PYTHONPATH")]))
        with theirs, nullcontext() if log is None else open(log, "ab") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **(environment or {}), "PYTHONPATH": importable},
            )

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *error: object) -> None:
        self.connection.close()
        self._end()

    def send(self, message: Any) -> None:
        """Send a message. If the process is dead, this does nothing: `receive` reports it."""
        with suppress(BrokenPipeError):
            self.connection.send(message)

    def receive(self) -> Any:
        """Wait for the next message. Raises it if it is an exception, and EOFError if the process ended instead."""
        try:
            message = self.connection.recv()
        except (EOFError, ConnectionResetError):
            raise EOFError(f"process {self.process.pid} {self._end()}") from None
        if isinstance(message, Exception):
            raise message
        return message

    def _end(self) -> str:
        try:
            code = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"


def parent() -> Connection:
    """In a `Child`, the connection to its parent. The child ignores Ctrl-C from here on; its parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return Connection(int(sys.argv[1]))


@contextmanager
def one_core() -> Iterator[None]:
    """This process runs on a random one of its cores, if the system can do that, and afterwards on all of them again.

    Some libraries start a thread for each core when they are first used. If this happens here, they start none.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {random.choice(sorted(cores))})
    try:
        yield
    finally:
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):  # it has ended
                os.sched_setaffinity(int(thread), cores)


def usable_cores() -> int:
    """Number of cores that this process may use, which its CPU affinity or a Slurm job may limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")  # Slurm may grant cores without binding to them
    return min(cores, int(granted)) if granted.isdigit() else cores


def cpu_has_bfloat16() -> bool:
    """Whether this CPU has bfloat16 units; False if the system does not list them."""
    words = _of_the_cpu().split()
    return "amx_bf16" in words or "avx512_bf16" in words


def machine() -> str:
    """The number and kind of this machine's processors.

    Examples:
        >>> machine().partition(" cores of ")[0].isdigit()
        True
    """
    name = re.search(r"model name\s*: (.+)", _of_the_cpu())
    units = "with" if cpu_has_bfloat16() else "without"
    return f"{os.cpu_count()} cores of {name[1] if name else platform.machine()} {units} bfloat16 units"


def _of_the_cpu() -> str:
    file = Path("/proc/cpuinfo")
    return file.read_text() if file.exists() else ""


def announce(message: str) -> None:
    """Print one line to standard error; names in it may come from a stranger's files."""
    print(one_line(message), file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Seconds in a readable unit.

    Examples:
        >>> duration(89), duration(600), duration(111_600)
        ('89 s', '10 min', '31.0 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
