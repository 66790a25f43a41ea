"""SIGINT and SIGTERM as an orderly stop: what runs is recorded as interrupted, and the exit status says why."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(SystemExit):
    """The process was asked to stop; its exit status is 128 + the signal's number, as shells expect."""

    def __init__(self, signum: int) -> None:
        super().__init__(128 + signum)
        self.name = signal.Signals(signum).name

    def __str__(self) -> str:
        return self.name


@contextmanager
def stopping_on_signals() -> Iterator[None]:
    """Let SIGINT and SIGTERM raise Stopped in the enclosed work.

    Left to itself, Lightning turns a SIGTERM into exit status 0, and a sweep goes on as if nothing had happened.
    """

    def stop(signum: int, frame: FrameType | None) -> None:
        raise Stopped(signum)

    before = {signum: signal.signal(signum, stop) for signum in SIGNALS}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


@contextmanager
def ending_with(parent: int | None) -> Iterator[None]:
    """Let this process ask itself to stop when its parent is gone, while the body runs; None: whatever happens to it.

    A killed parent cannot tell its children. Those of joblib would work through all that they were given.
    """
    over = threading.Event()

    def watch() -> None:
        while os.getppid() == parent:
            if over.wait(1.0):
                return
        os.kill(os.getpid(), signal.SIGTERM)

    if parent is not None:
        threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        over.set()
