"""Reads the weights of a checkpoint, which may be a stranger's file, into a network."""

from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import torch
from torch import nn

from phd_exp.records.errors import RunError, reading
from phd_exp.records.files import require_plain

ADVICE = "delete it to begin the run again"
WEIGHTS = "regressor."  # prefix of the network's weights in a checkpoint


def load_checkpoint(file: Path, map_location: Any = None) -> dict[str, Any]:
    """The content of a checkpoint: tensors and plain containers. No code in the file is executed.

    Raises RunError, one line, for any other file.
    """
    with reading(file, ADVICE, RunError, "not a whole checkpoint"):
        require_plain(file)
        with ZipFile(file) as archive:  # a compressed file may unpack to any size
            if any(entry.compress_type != ZIP_STORED for entry in archive.infolist()):
                raise ValueError("its content is compressed, which torch never does")
        try:
            content = torch.load(file, map_location or "cpu", weights_only=True)
        except UnpicklingError:
            raise ValueError("holds more than tensors and plain values, which is not read") from None
        if not isinstance(content, dict):
            raise ValueError("not of a run")
        return content


def regressor_weights(checkpoint: Path) -> dict[str, Any]:
    """The weights of the network in a checkpoint of a run. Raises RunError if there is none."""
    if not checkpoint.exists():
        raise RunError(f"{checkpoint}: missing; the run has not trained a whole epoch yet")
    state = load_checkpoint(checkpoint).get("state_dict")
    if not isinstance(state, dict):
        raise RunError(f"{checkpoint}: not a checkpoint of this network (no state_dict)")
    return {name.removeprefix(WEIGHTS): value for name, value in state.items() if str(name).startswith(WEIGHTS)}


def fill(network: nn.Module, weights: dict[str, Any], checkpoint: Path, assign: bool = False) -> None:
    """Set the weights of a network; raises RunError unless they fit it. `assign` replaces tensors without memory."""
    try:
        for name, value in weights.items():
            if value.nbytes > value.untyped_storage().nbytes():
                raise ValueError(f"{name}: repeats numbers, which no trained weight does")
        network.load_state_dict(weights, assign=assign)
    except Exception as error:  # torch raises many kinds for other weights, or none
        reason = " ".join(str(error).split())[:120]
        raise RunError(f"{checkpoint}: not a whole checkpoint of this network ({reason})") from None
