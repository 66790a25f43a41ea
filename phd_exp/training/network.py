"""The network, its focal lengths and the weights of a checkpoint, without Lightning: shared with prediction."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from jaxtyping import Float, Int
from torch import Tensor, nn

from phd_exp.data.images import SHRINKING
from phd_exp.geometry.charts import DepthScale
from phd_exp.models.backbones import Backbone, pooled
from phd_exp.models.regressor import FocalLengthInput, Regressor
from phd_exp.records.errors import ConfigError, RunError, gist, in_user_code, install
from phd_exp.records.files import require_plain
from phd_exp.records.processes import cpu_has_bfloat16
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig
from phd_exp.training.config.sections import TrainerConfig
from phd_exp.training.config.targets import custom_parts

ADVICE = "delete it to begin the run again"
GOLDEN = (math.sqrt(5) - 1) / 2


def build_regressor(config: RunConfig, depth: DepthScale, is_new: bool = True) -> Regressor:
    """The network, initialised from torch's current random state; unless it is new, no pretrained weights are read.

    Raises ConfigError, naming the key, for values that a part refuses.
    """
    # partial, then called: `instantiate` would convert an object among its arguments to a configuration
    with naming("model.head", config.model.head):
        head = instantiate(config.model.head, _partial_=True)(depth=depth)
    node = config.backbone if is_new else _without_weights(config.backbone)
    with naming("backbone", node):
        backbone = instantiate(node)
        if isinstance(backbone, nn.Module) and not isinstance(backbone, Backbone):
            backbone = pooled(backbone, config.data.image_size)
        if not isinstance(backbone, Backbone):
            raise ValueError(f"{node['_target_']} makes a {type(backbone).__name__}; expected a torch.nn.Module")
        is_input = config.camera.focal_length == "shown"
        shown = FocalLengthInput(head.n_outputs, depth) if is_input else None
        return Regressor(backbone, head, shown, config.recipe.exposure)


def _without_weights(node: Any) -> Any:
    """A node without the arguments by which networks read or download weights: those of the checkpoint follow."""
    if isinstance(node, list):
        return [_without_weights(value) for value in node]
    if not isinstance(node, dict):
        return node
    return {key: _without_weights(value) for key, value in node.items() if key not in ("pretrained", "weights")}


@contextmanager
def naming(key: str, node: dict[str, Any]) -> Iterator[None]:
    """Convert the errors of a part to a ConfigError that names its section of the configuration and its file."""
    try:
        yield
    except Exception as error:
        place = in_user_code(error)
        if place is None and not isinstance(error, ValueError | TypeError | OSError | RuntimeError | HydraException):
            raise
        own = dict.fromkeys(custom_parts(node).values())
        files = ", ".join(file for file in own if "site-packages" not in file)
        cause = error.__cause__ or error
        reason = place or gist(cause) + (f" ({files})" if files else "")
        raise ConfigError(f"{key}: {reason}{install(str(cause)) if isinstance(cause, ImportError) else ''}") from None


def f_factor(row: Int[Tensor, " batch"], f_error: float, epoch: int = 0) -> Float[Tensor, " batch"]:
    """Focal length that the model receives relative to the true one: exp(f_error e), with the `standard_error` e.

    Evaluations have the errors of epoch 0, so that every record of a sample has the same.
    """
    return (f_error * standard_error(row, epoch)).exp()


def standard_error(row: Int[Tensor, " batch"], epoch: int) -> Float[Tensor, " batch"]:
    """A standard normal number for each sample and epoch, evenly spread over samples and over epochs.

    It depends on (row, epoch) alone, so a resumed or distributed run trains on the same numbers.

    Source: multiples of irrational numbers modulo 1 are evenly distributed (Weyl); checked in
    tests/training/test_f_error.py.
    """
    place = row.double() * GOLDEN + epoch * math.sqrt(2)
    return torch.special.ndtri(place.frac().clamp(1e-6, 1 - 1e-6)).float()


def has_gpu(config: TrainerConfig) -> bool:
    """Whether a run trains on a GPU."""
    return config.accelerator != "cpu" and torch.cuda.is_available()


def precision(config: TrainerConfig) -> Any:
    """Lightning's name of the arithmetic: bfloat16 autocast on hardware with bfloat16 units.

    Without such units bfloat16 is three times slower than float32 on a CPU (resnet18, 112 px).
    """
    fast = torch.cuda.is_bf16_supported(including_emulation=False) if has_gpu(config) else cpu_has_bfloat16()
    return "bf16-mixed" if config.precision == "bfloat16" or (config.precision == "auto" and fast) else "32-true"


def require_same_shrinking(folder: RunFolder, config: RunConfig) -> None:
    """Raise RunError for a run trained with another version of `shrunk`, whose images differ."""
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
