"""Reads the weights of a checkpoint, which may be a stranger's file."""

from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import torch

from phd_exp.records.errors import RunError
from phd_exp.records.files import require_plain

ADVICE = "delete it to begin the run again"


def load_checkpoint(file: Path, map_location: Any = None) -> dict[str, Any]:
    """The content of a checkpoint: tensors and plain containers. No code in the file is executed.

    Raises RunError, one line, for any other file.
    """
    try:
        require_plain(file)
        with ZipFile(file) as archive:  # a compressed file may unpack to any size
            if any(entry.compress_type != ZIP_STORED for entry in archive.infolist()):
                raise ValueError("its content is compressed, which torch never does")
        content = torch.load(file, map_location or "cpu", weights_only=True)
    except UnpicklingError:
        raise RunError(f"{file}: holds more than tensors and plain values, which is not read; {ADVICE}") from None
    except Exception as error:  # torch raises any error on other bytes
        reason = " ".join((getattr(error, "strerror", None) or str(error).split("\n")[0]).split())[:120]
        raise RunError(f"{file}: not a whole checkpoint ({reason}); {ADVICE}") from None
    if not isinstance(content, dict):
        raise RunError(f"{file}: not a checkpoint of a run; {ADVICE}")
    return content
