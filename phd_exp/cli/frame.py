"""The frame around every verb and every job: whatever ends one becomes lines for the user and an exit status."""

import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from phd_exp.cli.signals import Stopped, stopping_on_signals
from phd_exp.records.errors import UNPRINTABLE, ConfigError, UserError, one_line

RESUMES = "the same command resumes"


class Ending(NamedTuple):
    """How a verb or a job ended.

    Attributes:
        state: one or two words.
        lines: what is wrong, one thing a line.
        exit_status: 0 if it ended well.
        value: the number that a sweeper minimizes.
    """

    state: str
    lines: tuple[str, ...] = ()
    exit_status: int = 0
    value: float | None = None


def failure(error: BaseException) -> Ending:
    """The ending by an error. A fault of the programme also prints its traceback."""
    if isinstance(error, Stopped):
        return Ending("interrupted", (f"stopped by {error}; {RESUMES}",), int(str(error.code)))
    if isinstance(error, UserError):
        return Ending("failed", tuple(str(error).splitlines()), 1)
    if isinstance(error, OSError) and error.strerror:
        line = f"{error.filename or 'output'}: {error.strerror}; mend that, and {RESUMES}"
    elif _is_out_of_memory(error):
        line = f"memory ran out; free some, and {RESUMES}, or lower data.batch_size, which makes a new run"
    else:
        traceback.print_exception(error)
        line = f"{type(error).__name__}: {error}"
    return Ending("failed", (one_line(line),), 1)


def run_verb(main: Callable[[list[str]], int], words: Sequence[str]) -> int:
    """Run a verb with the words of its command line; returns the exit status."""
    try:
        _require_visible(words)
        with stopping_on_signals():
            return main(list(words))
    except BrokenPipeError:
        raise
    except (Exception, Stopped) as error:
        ending = failure(error)
        print_errors(ending.lines)
        return ending.exit_status


def print_errors(lines: Iterable[str]) -> None:
    """Print what is wrong to standard error."""
    for line in lines:
        print(f"error: {line}", file=sys.stderr)


def _is_out_of_memory(error: BaseException) -> bool:
    # torch raises a RuntimeError on a CPU, and its own class on a GPU
    name = type(error).__name__
    return name in ("MemoryError", "OutOfMemoryError") or "can't allocate memory" in str(error)


def _require_visible(words: Sequence[str]) -> None:
    for word in words:
        if UNPRINTABLE.search(word):
            raise ConfigError(f"{one_line(word)}: holds control characters; expected printable KEY=VALUE")
