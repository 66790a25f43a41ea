"""The boundary around every verb and every job: any error or signal becomes lines for the user and an exit status."""

import os
import re
import signal
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NamedTuple

from phd_exp.records.errors import (
    CONTROLS,
    ConfigError,
    RenderError,
    RunError,
    UserError,
    in_user_code,
    install,
    one_line,
)
from phd_exp.records.processes import announce

RESUMES = "the same command resumes"
HOME = re.compile(r"(?<=[=,'\"\[])~[\w.-]*(?=[/,'\"\]]|$)")
"""`~` or `~user` at the beginning of a value. A shell expands it only at the beginning of a word."""


class Stopped(SystemExit):
    """The process received a signal. The exit status is 128 + the signal's number, as shells expect."""

    def __init__(self, signum: int) -> None:
        super().__init__(128 + signum)
        self.signum = signum

    def __str__(self) -> str:
        return signal.Signals(self.signum).name


class Ending(NamedTuple):
    """How a verb or a job ended.

    Attributes:
        state: one or two words.
        lines: the errors, one a line.
        exit_status: 0 for success, 2 for a wrong configuration or wrong arguments.
        value: the number that a sweeper minimizes.
    """

    state: str
    lines: tuple[str, ...] = ()
    exit_status: int = 0
    value: float | None = None


def failure(error: BaseException) -> Ending:
    """The ending that an error causes. An unexpected error also prints its traceback."""
    if isinstance(error, Stopped):
        return Ending("interrupted", (f"stopped by {error}; {RESUMES}",), 128 + error.signum)
    if isinstance(error, UserError):
        several = isinstance(error, ConfigError | RunError | RenderError)  # in others, a line break is a stranger's
        lines = tuple(str(error).splitlines()) if several else (str(error),)
        return Ending("failed", lines, 2 if isinstance(error, ConfigError) else 1)
    if isinstance(error, ModuleNotFoundError) and (remedy := install(error.name or "")):
        return Ending("failed", (f"{error}{remedy}",), 2)
    # torch raises a RuntimeError on a CPU, and a class of the second name on a GPU
    no_memory = type(error).__name__ in ("MemoryError", "OutOfMemoryError")
    if isinstance(error, OSError) and error.strerror:
        line = f"{error.filename or 'output'}: {error.strerror}; mend that, and {RESUMES}"
    elif no_memory or "can't allocate memory" in str(error):
        line = f"memory ran out; free some, and {RESUMES}, or lower data.batch_size, which makes a new run"
    elif place := in_user_code(error):
        line = f"{place}; mend it, and {RESUMES}"
    else:
        if type(error).__name__ != "MisconfigurationException":  # Lightning's, of arguments that do not fit
            traceback.print_exception(error)
        line = f"{type(error).__name__}: {error}"
    return Ending("failed", (one_line(line),), 1)


def run_verb(main: Callable[[list[str]], int], words: list[str]) -> int:
    """Run a verb with the words of its command line; returns the exit status."""
    try:
        words = [HOME.sub(lambda found: os.path.expanduser(found[0]), word) for word in words]
        for word in filter(CONTROLS.search, words):
            raise ConfigError(f"{one_line(word)}: holds control characters; expected printable KEY=VALUE")
        with stopping_on_signals():
            return main(words)
    except BrokenPipeError:
        raise
    except (Exception, Stopped) as error:
        ending = failure(error)
        print_errors(ending.lines)
        return ending.exit_status


def print_errors(lines: Iterable[str]) -> None:
    """Print errors to standard error."""
    for line in lines:
        announce(f"error: {line}")


@contextmanager
def stopping_on_signals() -> Iterator[None]:
    """Make SIGINT and SIGTERM raise Stopped in the body.

    Without this, Lightning ends with status 0 after a SIGTERM, and a sweep continues with its next job.
    """

    def stop(signum: int, frame: FrameType | None) -> None:
        with suppress(OSError):  # standard error may be closed; print() may be at work
            os.write(2, f"{signal.Signals(signum).name} received: stopping\n".encode())
        raise Stopped(signum)

    before = {signum: signal.signal(signum, stop) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


@contextmanager
def ending_with(parent: int | None) -> Iterator[None]:
    """Send SIGTERM to this process if its parent ends during the body, and end it after the body; None disables this.

    A killed launcher cannot stop its workers: those of joblib would run all jobs that they have been given.
    """
    over = threading.Event()

    def watch() -> None:
        while os.getppid() == parent:
            if over.wait(1.0):
                return
        os.kill(os.getpid(), signal.SIGTERM)
        over.wait()
        os._exit(128 + signal.SIGTERM)  # a worker would wait for further jobs

    try:
        if parent is not None:
            threading.Thread(target=watch, daemon=True).start()
        yield
    finally:
        over.set()
