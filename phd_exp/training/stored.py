"""Reading a run folder that may come from someone else: checkpoints are read as numbers only."""

from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import torch

from phd_exp.data.images import SHRINKING
from phd_exp.records.errors import RunError
from phd_exp.records.files import require_plain
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig

ADVICE = "delete it to begin the run again"


def require_same_shrinking(folder: RunFolder, config: RunConfig) -> None:
    """Raise RunError if the run was trained on images that another version of `shrunk` made differently."""
    data = config.data
    if not isinstance(data, RenderedConfig) or not folder.last_checkpoint.exists():
        return
    constants = folder.constants() if folder.constants_file.exists() else {}
    before, after = data.spec.sensor_size, data.image_size
    if before % after and constants.get("shrinking") != SHRINKING:
        raise RunError(
            f"{folder.path}: trained with images shrunk from {before} to {after} pixels by an earlier version, which "
            "shifted them; move the folder away and train again"
        )


def load_checkpoint(file: Path, map_location: Any = None) -> dict[str, Any]:
    """What a checkpoint holds: tensors and plain containers, whoever wrote it; no code of it is run.

    Raises RunError, one line, for everything else.
    """
    try:
        require_plain(file)
        _require_unpacked(file)
        content = torch.load(file, map_location or "cpu", weights_only=True)
    except UnpicklingError:
        raise RunError(
            f"{file}: holds more than tensors and plain values, which is not read; {ADVICE}"
        ) from None
    except (
        Exception
    ) as error:  # on bytes that are no checkpoint torch's reader raises whatever it stumbles over
        reason = getattr(error, "strerror", None) or str(error).split("\n")[0]
        raise RunError(
            f"{file}: not a whole checkpoint ({' '.join(reason.split())[:120]}); {ADVICE}"
        ) from None
    if not isinstance(content, dict):
        raise RunError(f"{file}: not a checkpoint of a run; {ADVICE}")
    return content


def _require_unpacked(file: Path) -> None:
    """Raise ValueError unless the file is an archive as torch writes it: what is packed may unfold without end."""
    with ZipFile(file) as archive:
        if any(entry.compress_type != ZIP_STORED for entry in archive.infolist()):
            raise ValueError("its content is compressed, which torch never does")
