"""Locks between processes, on one machine or on many that share a file system.

They are `flock`s: the system drops them when a process dies, however it dies, and several processes may hold one
together. On NFS the server must know locks (every NFS 4 does), on Lustre the mount option is `flock`.
"""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from phd_exp.rendering.progress import announce


@contextmanager
def held(path: Path, *, shared: bool = False, waiting: str) -> Iterator[None]:
    """Hold a lock in the body: alone, or `shared` with all who ask so; says `waiting` where it has to wait."""
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+b") as stream:  # on NFS a shared lock wants reading, the other kind writing
        if not _taken_at_once(stream.fileno(), kind):
            announce(waiting)
            fcntl.flock(stream, kind)
        yield


@contextmanager
def held_if_free(path: Path) -> Iterator[bool]:
    """Hold a lock alone in the body if nobody else holds it; the body is told whether it does."""
    with open(path, "a+b") as stream:
        yield _taken_at_once(stream.fileno(), fcntl.LOCK_EX)


def _taken_at_once(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
