"""Errors that a user can fix: one line with the fault, its place, what was expected and what to do."""

import difflib
import inspect
import re
import sysconfig
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, Tag, ValidationError
from pydantic_core import ErrorDetails

LONGEST_GIST = 400  # characters of an error that a message repeats
LONGEST_VALUE = 120  # characters of a value that a message repeats
CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Characters that end a line, control a terminal, or turn the direction of the text that follows."""
_PACKAGE = Path(__file__).parents[1]
_LIBRARIES = (str(_PACKAGE), str(_PACKAGE.parent / "hydra_plugins"), sysconfig.get_path("stdlib"), "<")
"""Beginnings of the file names of this package, the standard library, and code without a file."""
EXTRAS = {
    "hydra": "train", "omegaconf": "train", "lightning": "train", "wandb": "train", "torchmetrics": "train",
    "torchvision": "train", "bpy": "render", "matplotlib": "report", "plotly": "report", "jinja2": "report",
    "onnx": "export", "onnxscript": "export", "onnxruntime": "export", "optuna": "search", "tensorboard": "loggers",
    "mlflow": "loggers", "timm": "timm", "av": "video", "joblib": "launchers", "submitit": "launchers", "ray": "ray",
    "rosbags": "ros", "pandas": "report",
}  # fmt: skip
"""Optional package -> the extra of phd_exp that installs it."""
READABLE = "make it a readable file"
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


@dataclass(eq=False)
class reading:  # noqa: N801 - used as contextlib.suppress
    """Convert any error in the body, which reads a file of others, to a UserError of a `kind`, one line.

    The line has the place, the reason, and a remedy: `otherwise`, but READABLE if the system refuses to read. A
    UserError passes unchanged. Parsers raise errors of many kinds on damaged files, hence `Exception`.
    """

    where: object
    otherwise: str = ""
    kind: type[UserError] = DatasetError
    what: str = "cannot be read"

    def __enter__(self) -> None:
        pass

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, Exception) and not isinstance(error, UserError):
            refused = isinstance(error, OSError) and error.errno and not isinstance(error, FileNotFoundError)
            remedy = f"; {READABLE if refused else self.otherwise}" if self.otherwise else ""
            raise self.kind(f"{self.where}: {self.what} ({one_line(gist(error))}){remedy}") from error


def listed(names: Sequence[str]) -> str:
    """Names for a message, of many the first ones."""
    rest = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"{', '.join(names[:NAMED])}{rest}"


def unknown(word: str, valid: Iterable[str], expected: str = "", fault: str = "unknown key") -> str:
    """The message about a wrong word: its fault, the nearest valid word, and what is expected (default: all of them).

    Words are compared by what follows their last `.` or `=`.

    Examples:
        >>> unknown("epochs", ["data.n_train", "trainer.max_epochs"], "expected a key")
        "epochs: unknown key, did you mean 'trainer.max_epochs'?; expected a key"
    """
    names = list(valid)
    ends = {re.split("[.=]", name)[-1]: name for name in reversed(names)}  # of equal ends the first
    close = difflib.get_close_matches(re.split("[.=]", word)[-1], ends, n=1)
    near = f", did you mean {ends[close[0]]!r}?" if close else ""
    return f"{word}: {fault}{near}; {expected or 'expected one of ' + ', '.join(names)}"


def complaint(problem: ErrorDetails, model: type[BaseModel] | None = None, missing: str = "") -> str:
    """Pydantic's error as a message: the key, its value unless that is a whole section, and what was expected.

    The message about an unknown key lists the keys of its section of the `model`; that about a missing one ends with
    `missing`, where `{key}` is replaced by the key.
    """
    place = [str(part) for part in problem["loc"]]
    key = ".".join(part for part in place if part != "spec" and not part.startswith("<"))
    if problem["type"] == "target":  # of a class or function, whose parameter the text names
        return f"{key}.{problem['ctx']['text']}"
    if problem["type"] == "extra_forbidden" and model:
        return unknown(key, _keys(model, place[:-1]))
    if problem["type"] == "missing":
        return f"{key}: missing" + f"; {missing.format(key=key)}" * bool(missing)
    given = "" if isinstance(problem["input"], dict) else f"got {shown(problem['input'])}; "
    expected = problem["msg"].removeprefix("Value error, ").replace("Input should be", "expected to be")
    reason = given + expected.replace("expected to be a valid", "expected a valid")
    return f"{key}: {reason}" if key else reason


def _keys(model: Any, place: list[str]) -> list[str]:
    """The keys of the section at a place: names of fields, and tags of unions."""
    for name in place:
        if name.startswith("<"):
            model = next(get_args(member)[0] for member in get_args(model) if Tag(name) in get_args(member))
        else:
            # of a mapping from names to sections, the section
            model = get_args(model)[1] if get_origin(model) is dict else model.model_fields[name].annotation
    model = next((member for member in get_args(model) if inspect.isclass(member)), model)  # of Section | None
    return [*keys_of_section(model)]


def keys_of_section(model: Any) -> dict[str, Any]:
    """The keys of a section as a user writes them, with their types; keys of `spec` are one level up."""
    types = {name: field.annotation for name, field in model.model_fields.items()}
    spec = types.pop("spec", None)
    return types | (keys_of_section(spec) if spec else {})


def install(text: str) -> str:
    """`; pip install 'phd_exp[EXTRA]'` if a message about a missing package names an optional one, else empty."""
    words = re.findall(r"[a-z0-9]+", text)
    extras = [EXTRAS[word] for word in words if word in EXTRAS]
    extra = next(iter(sorted(extras, key="train".__eq__)), None)  # plugins of hydra and lightning name these too
    return f"; pip install 'phd_exp[{extra}]'" if extra else ""


def gist(error: BaseException) -> str:
    """The reason of an error on one line: the first complaint of a validation, or the reason of a system call.

    Of an error without a message, the name of its class.
    """
    if isinstance(error, ValidationError):
        text = complaint(error.errors(include_url=False)[0])
    else:
        text = str(getattr(error, "strerror", None) or error) or type(error).__name__
    missing = " is missing" if isinstance(error, KeyError) else ""
    return " ".join(text.split())[:LONGEST_GIST] + missing


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
