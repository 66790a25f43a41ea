"""What can go wrong while rendering and is the user's to mend."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from phd_exp.records.errors import UserError


class RenderError(UserError):
    """Rendering cannot start or go on: one line that says what happened and what to do."""


def unwritable(error: OSError, folder: Path, instead: str = "data.root") -> RenderError:
    """A folder without permission, a full disk and their like, said in one line; `instead` chooses another folder."""
    return RenderError(
        f"{error.filename or folder}: cannot be written ({error.strerror or error}); make room, allow writing, "
        f"or choose another {instead}"
    )


@contextmanager
def writing(folder: Path, instead: str = "data.root") -> Iterator[None]:
    """An unwritable folder or a full disk is one line, not a stack of calls."""
    try:
        yield
    except OSError as error:
        raise unwritable(error, folder, instead) from error
