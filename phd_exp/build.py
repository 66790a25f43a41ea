"""From a checked configuration to its parts: the network and the source of samples, without Lightning."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from phd_exp.config import FolderConfig, RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig
from phd_exp.config.targets import OTHER_VERSION, build, custom_parts, is_ours
from phd_exp.data.folder import FolderSource
from phd_exp.data.images import SHRINKING
from phd_exp.data.sources import Part, RenderedSource, Source
from phd_exp.geometry.charts import DepthScale
from phd_exp.models.backbones import Backbone, pooled
from phd_exp.models.regressor import FocalLengthInput, Regressor
from phd_exp.models.trained import TrainedNetwork
from phd_exp.models.weights import fill, regressor_weights
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, RunError, UserError, gist, in_user_code, install
from phd_exp.records.own_images import DetectionFolder
from phd_exp.records.runs import RunFolder

CONSTANTS = ("mu_z0", "D", "z_centre", "constant_f")
LEAST_CONSTANT = 1e-9  # the shortest distance over the longest focal length, m/px; the largest is its inverse


def build_source(data: DataConfig) -> Source:
    """The source of samples that a `data` section describes. Raises ConfigError, naming the key, for bad values."""
    if isinstance(data, FolderConfig):
        folder = DetectionFolder(data.folder, data.object)
        return FolderSource(folder, data.n_train, data.n_held_out, data.n_test, data.image_size)
    sizes: dict[Part, int] = {"train": data.n_train, "held_out": data.n_held_out, "test": data.n_test}
    if isinstance(data, RenderedConfig):
        return RenderedSource(DatasetFolder(data.folder), data.spec, sizes, data.image_size)
    with naming("data.source", data.source):
        source = build(data.source, is_partial=True)(n=sizes, side=data.image_size)
        if not isinstance(source, Source):
            raise ValueError(f"makes a {type(source).__name__}; expected a phd_exp.data.sources.Source")
        return source


def build_regressor(config: RunConfig, depth: DepthScale, is_new: bool = True) -> Regressor:
    """The network, initialised from torch's current random state; unless it is new, no pretrained weights are read.

    Raises ConfigError, naming the key, for values that a part refuses.
    """
    with naming("model.head", config.model.head):
        head = build(config.model.head, is_partial=True)(depth=depth)
    node = config.backbone if is_new else _without_weights(config.backbone)
    with naming("backbone", node):
        backbone = build(node)
        if isinstance(backbone, nn.Module) and not isinstance(backbone, Backbone):
            backbone = pooled(backbone, config.data.image_size)
        if not isinstance(backbone, Backbone):
            raise ValueError(f"{node['_target_']} makes a {type(backbone).__name__}; expected a torch.nn.Module")
        is_input = config.camera.focal_length == "shown"
        f_input = FocalLengthInput(head.n_outputs, depth) if is_input else None
        return Regressor(backbone, head, f_input, config.recipe.exposure, config.recipe.hidden)


def _without_weights(node: Any) -> Any:
    """A node without the arguments by which networks read or download weights: those of the checkpoint follow."""
    if isinstance(node, list):
        return [_without_weights(value) for value in node]
    if not isinstance(node, dict):
        return node
    return {key: _without_weights(value) for key, value in node.items() if key not in ("pretrained", "weights")}


def trained_network(
    folders: Sequence[RunFolder], configs: Sequence[RunConfig], views: int = 1, device: str = "auto"
) -> TrainedNetwork:
    """The networks of runs with the weights of their best checkpoints, or their last, as one ensemble.

    Raises RunError for a run without usable weights or constants, ConfigError for a configuration that describes no
    network, or one that joins no ensemble.
    """
    constant_f = recorded_constants(folders[0])[1] if configs[0].camera.focal_length == "constant" else None
    networks = [_trained(folder, config) for folder, config in zip(folders, configs, strict=True)]
    place = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    try:
        return TrainedNetwork(networks, configs[0].data.image_size, constant_f, views).to(place)
    except ValueError as error:
        raise ConfigError(f"{folders[0].path}: {error}") from None


def _trained(folder: RunFolder, config: RunConfig) -> Regressor:
    """The network of one run, of whose checkpoint only tensors are read.

    It is first built without memory, and must fit: a stored configuration may describe a network of any size.
    """
    require_same_shrinking(folder, config.data)
    depth, _ = recorded_constants(folder)
    weights = regressor_weights(folder.best_checkpoint)
    # the user's own networks may need their numbers
    if not custom_parts({"head": config.model.head, "backbone": config.backbone}):
        with torch.device("meta"), _Uninitialised():
            fill(_stored(folder, config, depth), weights, folder.best_checkpoint, assign=True)
    regressor = _stored(folder, config, depth)
    fill(regressor, weights, folder.best_checkpoint)
    return regressor


class _Uninitialised(TorchFunctionMode):
    """Leaves out normal random numbers, for which torch imports its compiler where tensors have no memory."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func is torch.Tensor.normal_ else func(*args, **(kwargs or {}))


def _stored(folder: RunFolder, config: RunConfig, depth: DepthScale) -> Regressor:
    """A network that a run folder describes, which may be of another version, or a stranger's."""
    try:
        return build_regressor(config, depth, is_new=False)
    except UserError as error:
        if not is_ours([config.model.head, config.backbone]):
            raise
        raise ConfigError(f"{error}{OTHER_VERSION}") from error
    except Exception as error:  # parts that a stranger has named may raise any
        reason = f"{type(error).__name__}: {gist(error)}"
        raise ConfigError(f"{folder.config_file}: describes no network ({reason}){OTHER_VERSION}") from error


@contextmanager
def naming(key: str, node: dict[str, Any]) -> Iterator[None]:
    """Convert the errors of a part to a ConfigError that names its section of the configuration and its file."""
    try:
        yield
    except Exception as error:
        place = in_user_code(error)
        if place is None and not isinstance(error, ValueError | TypeError | OSError | RuntimeError):
            raise
        own = dict.fromkeys(custom_parts(node).values())
        files = ", ".join(file for file in own if "site-packages" not in file)
        cause = error.__cause__ or error
        reason = place or gist(cause) + (f" ({files})" if files else "")
        raise ConfigError(f"{key}: {reason}{install(str(cause)) if isinstance(cause, ImportError) else ''}") from None


def require_same_shrinking(folder: RunFolder, data: DataConfig) -> None:
    """Raise RunError for a run trained with another version of `shrunk`, whose images differ."""
    if not isinstance(data, RenderedConfig) or not folder.last_checkpoint.exists():
        return
    constants = folder.constants() if folder.constants_file.exists() else {}
    before, after = data.spec.sensor_size, data.image_size
    if before % after and constants.get("shrinking") != SHRINKING:
        raise RunError(
            f"{folder.path}: trained with images shrunk from {before} to {after} pixels by an earlier version, which "
            "shifted them; move the folder away and train again"
        )


def recorded_constants(folder: RunFolder) -> tuple[DepthScale, float]:
    """Depth scale and constant f of the run's data, as recorded."""
    file = folder.constants_file
    if not file.exists():
        raise RunError(f"{file}: missing, so that the depth scale of its data is unknown; train the run again")
    values = folder.constants()
    try:
        *scale, constant_f = (float(values[name]) for name in CONSTANTS)
        for name, value in zip(CONSTANTS, (*scale, constant_f), strict=True):
            if not LEAST_CONSTANT <= value <= 1 / LEAST_CONSTANT:
                raise ValueError(f"{name} must be {LEAST_CONSTANT} to {1 / LEAST_CONSTANT:g}, but is {value}")
        return DepthScale(*scale), constant_f
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{file}: not the constants of a run ({error})") from None
