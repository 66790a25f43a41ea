"""A run as one file that others predict with; see `records.packed` for its form."""

import io
from pathlib import Path

import torch

from phd_exp.config import check
from phd_exp.config.targets import Trust
from phd_exp.inference.card import UNKNOWN, card
from phd_exp.models.weights import WEIGHTS as PREFIX
from phd_exp.models.weights import regressor_weights
from phd_exp.records.errors import RunError
from phd_exp.records.files import read_plain
from phd_exp.records.packed import CARD, LARGEST, WEIGHTS, recorded_files, write_packed
from phd_exp.records.runs import RunFolder


def pack(run: RunFolder, out: Path, license: str = UNKNOWN, trust: Trust = ()) -> dict[str, int]:
    """Write a finished run as an archive; returns the bytes of each of its files by name.

    Of the checkpoint that is evaluated, it holds the weights of the network and nothing else.

    Raises RunError for a run that is not finished or whose record cannot be read, ConfigError for a configuration
    that is invalid or names code that is not trusted.
    """
    if not run.path.is_dir() or not run.is_finished():
        raise RunError(f"{run.path}: expected the folder of a finished run")
    checkpoint = run.best_checkpoint
    if checkpoint.is_symlink() or run.checkpoints.is_symlink():
        raise RunError(f"{checkpoint}: is a link; put the file or folder itself in its place")
    contents = {CARD: card(run, check(run.config(), trust), license).encode(), WEIGHTS: _weights(checkpoint)}
    for name, path in recorded_files(run):
        contents[name] = read_plain(path, LARGEST)
    write_packed(out, contents)
    return {name: len(content) for name, content in contents.items()}


def _weights(checkpoint: Path) -> bytes:
    """A checkpoint with the weights of the network alone: no states of optimizers, no paths."""
    weights = {f"{PREFIX}{name}": value.clone() for name, value in regressor_weights(checkpoint).items()}
    stream = io.BytesIO()
    torch.save({"state_dict": weights}, stream)
    return stream.getvalue()
