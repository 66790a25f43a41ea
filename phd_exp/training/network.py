"""A checked configuration -> the network alone, without Lightning: what training and prediction share."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate

from phd_exp.geometry.charts import DepthScale
from phd_exp.models.backbones import Backbone
from phd_exp.models.focal_length import FocalLengthInput
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import ConfigError
from phd_exp.training.config import RunConfig, TrainerConfig


def build_regressor(config: RunConfig, depth: DepthScale) -> Regressor:
    """The network, initialised from torch's current random state.

    Raises ConfigError, naming the key, where a part refuses its values.
    """
    # partial, then called: an object among instantiate's own arguments would be turned into a configuration
    with naming("model.head"):
        head = instantiate(config.model.head, _partial_=True)(depth=depth)
    with naming("backbone"):
        backbone = instantiate(config.backbone)
        if not isinstance(backbone, Backbone):
            raise ValueError(
                f"_target_: {config.backbone['_target_']!r} makes no Backbone; see conf/backbone"
            )
        shown = FocalLengthInput(head.n_outputs, depth) if config.camera.focal_length == "shown" else None
        return Regressor(backbone, head, shown)


@contextmanager
def naming(key: str) -> Iterator[None]:
    """Let what a part says of its values name the part of the configuration that they stand in."""
    try:
        yield
    except (ValueError, TypeError, InstantiationException) as error:
        reason = " ".join(str(error.__cause__ or error).split())
        raise ConfigError(f"{key}: {reason}") from None


def has_gpu(config: TrainerConfig) -> bool:
    """Whether a run is trained on a GPU."""
    return config.accelerator != "cpu" and torch.cuda.is_available()


def precision(config: TrainerConfig) -> Any:
    """Lightning's name of the arithmetic: bfloat16 autocast where the hardware has units for it.

    Without such units bfloat16 is three times slower than float32 on a CPU (resnet18, 112 px).
    """
    if config.precision != "auto":
        return {"float32": "32-true", "bfloat16": "bf16-mixed"}[config.precision]
    if has_gpu(config):
        return "bf16-mixed" if torch.cuda.is_bf16_supported(including_emulation=False) else "32-true"
    return "bf16-mixed" if cpu_has_bfloat16() else "32-true"


def cpu_has_bfloat16() -> bool:
    """Whether this CPU has units for bfloat16; false where it cannot be told."""
    flags = Path("/proc/cpuinfo")
    words = flags.read_text().split() if flags.exists() else []
    return "amx_bf16" in words or "avx512_bf16" in words
