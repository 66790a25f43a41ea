"""Errors that a user can fix: one line with the fault, its place, what was expected and what to do."""

import difflib
import re
import sysconfig
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError
from pydantic_core import ErrorDetails

LONGEST_GIST = 200  # characters of an error that a message repeats
LONGEST_VALUE = 120  # characters of a value that a message repeats
UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Characters that would end the line of a message, or control the terminal."""
_PACKAGE = Path(__file__).parents[1]
_LIBRARIES = (str(_PACKAGE), str(_PACKAGE.parent / "hydra_plugins"), sysconfig.get_path("stdlib"), "<")
"""Beginnings of the file names of this package, the standard library, and code without a file."""
EXTRAS = {
    "hydra": "train", "omegaconf": "train", "lightning": "train", "wandb": "train", "torchmetrics": "train",
    "torchvision": "train", "bpy": "render", "matplotlib": "report", "plotly": "report", "jinja2": "report",
    "onnx": "export", "onnxscript": "export", "onnxruntime": "export", "optuna": "search", "tensorboard": "loggers",
    "mlflow": "loggers", "timm": "timm", "av": "video", "joblib": "launchers", "submitit": "launchers", "ray": "ray",
    "rosbags": "ros",
}  # fmt: skip
"""Optional package -> the extra of phd_exp that installs it."""
NAMED = 5  # names that a message lists


class UserError(Exception):
    """An error that the user can fix; the command line prints it without a traceback."""


class ConfigError(UserError):
    """An invalid configuration: a key, its value, and what was expected."""


class RunError(UserError):
    """An unusable run folder: held by another process, made with another configuration, or broken."""


class DatasetError(UserError):
    """An unusable data set: incomplete, damaged, or with another specification."""


class RenderError(UserError):
    """Rendering cannot start or continue."""


class CorruptFileError(UserError):
    """A line of a file cannot be read."""


@contextmanager
def writing(folder: Path, instead: str = "data.root", kind: type[UserError] = RenderError) -> Iterator[None]:
    """Convert an OSError in the body, a read-only folder or a full disk, to a UserError of a `kind`.

    `instead` is the key by which to choose another folder.
    """
    try:
        yield
    except OSError as error:
        raise kind(
            f"{error.filename or folder}: cannot be written ({error.strerror or error}); make room, allow writing, "
            f"or choose another {instead}"
        ) from error


def listed(names: Sequence[str]) -> str:
    """Names for a message, of many the first ones."""
    rest = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{', '.join(names[:NAMED])}{rest}"


def nearest(word: str, valid: Iterable[str]) -> str:
    """`, did you mean 'lr'?` if the end of a valid word resembles that of the given one, else an empty string.

    Examples:
        >>> nearest("epochs", ["data.n_train", "trainer.max_epochs"])
        ", did you mean 'trainer.max_epochs'?"
    """
    ends = {end_of(name): name for name in reversed(list(valid))}  # of equal ends the first
    close = difflib.get_close_matches(end_of(word), ends, n=1)
    return f", did you mean {ends[close[0]]!r}?" if close else ""


def end_of(word: str) -> str:
    """The part of a word after its last `.` or `=`; the whole word without either."""
    return re.split("[.=]", word)[-1]


def instead(word: str, valid: Iterable[str], expected: str = "") -> str:
    """The end of a message about a wrong word: the nearest valid word, then what is expected (by default: all)."""
    names = list(valid)
    return f"{nearest(word, names)}; {expected or 'expected one of ' + ', '.join(names)}"


def unknown(key: str, valid: Iterable[str], expected: str = "") -> str:
    """The message about a key that is none of the valid ones."""
    return f"{key}: unknown key{instead(key, valid, expected)}"


def complaint(problem: ErrorDetails, valid: Iterable[str] = (), expected: str = "", key: str | None = None) -> str:
    """Pydantic's error as a message: the key, its value unless that is a whole section, and what was expected.

    A key that is not `valid`, or is missing, is followed by what is `expected`.
    """
    key, names = ".".join(map(str, problem["loc"])) if key is None else key, list(valid)
    if problem["type"] == "extra_forbidden" and names:
        return unknown(key, names, expected)
    if problem["type"] == "missing" and (names or expected):
        return f"{key}: missing" + f"; {expected}" * bool(expected)
    given = "" if isinstance(problem["input"], dict) else f"got {shown(problem['input'])}; "
    expected = problem["msg"].removeprefix("Value error, ").replace("Input should be", "expected to be")
    reason = given + expected.replace("expected to be a valid", "expected a valid")
    return f"{key}: {reason}" if key else reason


def install(text: str) -> str:
    """`; pip install 'phd_exp[EXTRA]'` if a message about a missing package names an optional one, else empty."""
    words = re.findall(r"[a-z0-9]+", text)
    extras = [EXTRAS[word] for word in words if word in EXTRAS]
    extra = next(iter(sorted(extras, key="train".__eq__)), None)  # plugins of hydra and lightning name these too
    return f"; pip install 'phd_exp[{extra}]'" if extra else ""


def gist(error: BaseException) -> str:
    """The reason of an error on one line: the first complaint of a validation, or the reason of a system call."""
    if isinstance(error, ValidationError):
        text = complaint(error.errors(include_url=False)[0])
    else:
        text = str(getattr(error, "strerror", None) or error)
    return " ".join(text.split())[:LONGEST_GIST]


def in_user_code(error: BaseException) -> str | None:
    """The error and its place, on one line, if it was raised below code that belongs to no library; else None.

    That is the user's own class or function; its last frame is the place.
    """
    place = None
    for frame in traceback.extract_tb(error.__traceback__):
        if not frame.filename.startswith(_LIBRARIES) and "site-packages" not in frame.filename:
            place = f"{frame.filename}, line {frame.lineno}"
    if isinstance(error, SyntaxError) and error.filename:
        place = f"{error.filename}, line {error.lineno}"
    if place is None:
        return in_user_code(error.__cause__) if error.__cause__ else None
    reason = error.msg if isinstance(error, SyntaxError) else str(error)
    return one_line(f"{type(error).__name__}: {reason} ({place})")


def one_line(text: str) -> str:
    """Foreign text as one line of visible characters: the others could control the terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


def shown(value: object) -> str:
    """A value for a message, of a long one the beginning."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, or deep nesting
        return f"<{type(value).__name__}>"
    return shortened(text)


def shortened(text: str, longest: int = LONGEST_VALUE) -> str:
    """A text for a message, of a long one the beginning."""
    return text if len(text) <= longest else f"{text[:longest]}..."
