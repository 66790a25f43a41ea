"""The errors a user can mend: each is one line that says what, where, what was expected and what to do."""

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError
from pydantic_core import ErrorDetails

LONGEST_GIST = 200
"""Characters of an error that a message repeats."""
LONGEST_VALUE = 120
"""Characters of a value that a message repeats."""
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Characters that would end the line of a message, or steer the terminal."""
NAMED = 5
"""Names that a message lists."""


class UserError(Exception):
    """Something the user asked for cannot be done as asked; the command line prints it without a traceback."""


class ConfigError(UserError):
    """A configuration that does not make sense: a key, its value, and what was expected instead."""


class RunError(UserError):
    """A run folder that cannot be used: held by another process, made by another configuration, or broken."""


class DatasetError(UserError):
    """A data set that cannot be used as asked: incomplete, of another specification, or damaged."""


class RenderError(UserError):
    """Rendering cannot start or continue."""


class CorruptFileError(UserError):
    """A line of a file cannot be read."""


def unwritable(error: OSError, folder: Path, instead: str = "data.root") -> RenderError:
    """The RenderError of a folder without permission or a full disk; `instead` names the key of another folder."""
    return RenderError(
        f"{error.filename or folder}: cannot be written ({error.strerror or error}); make room, allow writing, "
        f"or choose another {instead}"
    )


@contextmanager
def writing(folder: Path, instead: str = "data.root") -> Iterator[None]:
    """Raise `unwritable` for an OSError in the body."""
    try:
        yield
    except OSError as error:
        raise unwritable(error, folder, instead) from error


def listed(names: Sequence[str]) -> str:
    """Names as they stand in a message: of many the first."""
    rest = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{', '.join(names[:NAMED])}{rest}"


def nearest(key: str, valid: Iterable[str]) -> str:
    """`, did you mean 'lr'?` where a valid key looks like the one given; nothing otherwise."""
    close = difflib.get_close_matches(key, list(valid), n=1)
    return f", did you mean {close[0]!r}?" if close else ""


def in_our_words(message: str) -> str:
    """What pydantic says of a value, as the lines of this programme say it."""
    return (
        message.removeprefix("Value error, ")
        .replace("Input should be", "expected to be")
        .replace("expected to be a valid", "expected a valid")
    )


def complaint(key: str, problem: ErrorDetails) -> str:
    """What pydantic says of a key: its value, unless that is a whole section, and what was expected."""
    given = f"got {shown(problem['input'])}; " if key and not isinstance(problem["input"], dict) else ""
    return ": ".join(filter(None, [key, given + in_our_words(problem["msg"])]))


def gist(error: Exception) -> str:
    """Why something cannot be read, on one line: of a validation the first complaint, of a system call its reason."""
    if isinstance(error, ValidationError):
        problem = error.errors(include_url=False)[0]
        text = complaint(".".join(map(str, problem["loc"])), problem)
    else:
        text = str(getattr(error, "strerror", None) or error)
    return " ".join(text.split())[:LONGEST_GIST]


def one_line(text: str) -> str:
    """Text from outside as one line of visible characters: a terminal would obey the others."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


def shown(value: object) -> str:
    """A value as it stands in a message: of a long one the beginning."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits, nesting without end
        return f"<{type(value).__name__}>"
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}..."
