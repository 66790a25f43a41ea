"""Checkpoints that are whole or absent."""

import io
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import CheckpointIO

from phd_exp.records.files import write_atomic
from phd_exp.training.stored import load_checkpoint


class AtomicCheckpoints(CheckpointIO):
    """Writes a checkpoint beside itself and renames it into place.

    Lightning's own way writes to the system's folder for temporary files and moves it from there: between two file
    systems that is a copy, and a kill in the middle of it leaves half a checkpoint and a large stray file.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content.getvalue())

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = True
    ) -> dict[str, Any]:
        # Lightning's callbacks have nothing to remember here, and would remove the file that it calls the best
        return load_checkpoint(Path(path), map_location) | {"callbacks": {}}

    def remove_checkpoint(self, path: Any) -> None:
        Path(path).unlink(missing_ok=True)
