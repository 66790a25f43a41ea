"""Probabilistic 3-D position estimation from a single camera with the Projected Huber distribution."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from phd_exp.inference.predictor import Predictor

__version__ = "0.1.0"


def load(run: str | Path, device: str = "auto", recalibrate: bool = False, trust: tuple[str, ...] = ()) -> Predictor:
    """A trained run as a callable from images to predictions; see `phd_exp.inference.predictor.load`."""
    from phd_exp.inference import predictor  # torch, which importing phd_exp does without

    return predictor.load(Path(run), device, recalibrate, trust)
