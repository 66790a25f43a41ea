"""What the machine refuses in the middle of a run, in a line that says what to do."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from phd_exp.records.errors import RunError

GOES_ON = "the same command goes on from the last checkpoint"


@contextmanager
def told(folder: Path) -> Iterator[None]:
    """Turn a disk that is full or read-only, and memory that has run out, into a RunError; the run can go on."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunError(f"{error.filename or folder}: {reason}; mend that, and {GOES_ON}") from error
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        raise RunError(
            f"{folder}: memory ran out; leave it more, and {GOES_ON}, or choose a smaller data.batch_size, "
            "which is another run"
        ) from error


def _is_out_of_memory(error: BaseException) -> bool:
    # on a CPU torch raises a plain RuntimeError
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "can't allocate memory" in str(error)
