"""Processes that work together: locks on files, and lines for the person who waits."""

import fcntl
import os
import platform
import random
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from phd_exp.records.errors import one_line


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
