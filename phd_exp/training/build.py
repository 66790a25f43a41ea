"""Builds the objects of a checked configuration; `network.py` builds the network."""

import sys
from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from inspect import isclass, signature
from typing import Any

import torch
from hydra.utils import instantiate
from lightning import Trainer
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, ProgressBar, TQDMProgressBar
from torch import Tensor

from phd_exp.data.augmentation import Augmentation, Photometry
from phd_exp.data.datamodule import PositionData
from phd_exp.data.folder import FolderSource
from phd_exp.data.sources import Part, RenderedSource, Source
from phd_exp.geometry.camera import Camera
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.detections import DetectionFolder
from phd_exp.records.errors import ConfigError, nearest
from phd_exp.records.runs import RunFolder
from phd_exp.training.checkpoints import AtomicCheckpoints, StopBetweenBatches
from phd_exp.training.config import FolderConfig, RenderedConfig, RunConfig, SourceConfig
from phd_exp.training.config.sections import RecipeConfig
from phd_exp.training.config.targets import custom_parts, locate
from phd_exp.training.module import PositionModule, factor
from phd_exp.training.network import build_regressor, naming, precision
from phd_exp.training.progress import Progress
from phd_exp.training.recorder import Recorder

OWNED = {
    "callbacks": "set callbacks=NAME, or +callbacks.NAME._target_=CLASS",
    "logger": "set logger=NAME, or +logger.NAME._target_=CLASS",
    "check_val_every_n_epoch": "set evaluation.every_n_epochs",
    "val_check_interval": "set evaluation.every_n_epochs, since the record has one row an epoch",
    "enable_progress_bar": "set trainer.progress_bar",
    "default_root_dir": "set runs",
    "enable_checkpointing": "set callbacks for further checkpoints; runs resume from their own",
    "limit_predict_batches": "set data.n_test, since the record has all test samples",
    "num_sanity_val_steps": "leave it out: the untrained network is always evaluated",
    "use_distributed_sampler": "leave it out: batches are divided among the processes already",
    "reload_dataloaders_every_n_epochs": "leave it out: the data stays in memory",
    "strategy": "set trainer.devices",
    "num_nodes": "set trainer.devices, since all processes are on one machine",
    "plugins": "leave it out: they start the processes and write the checkpoints",
    "barebones": "leave it out: it would switch the run record off",
}
"""Arguments of Lightning's Trainer that the run record depends on, and what to do instead."""


def build_data(config: RunConfig, rank: int = 0) -> PositionData:
    """The data set of a run, or of one of its processes. `setup` opens the images."""
    return PositionData(
        _source(config.data),
        batch_size=config.data.batch_size,
        seed=config.seed,
        rank=rank,
        world=config.trainer.devices,
        augment=build_augmentation(config.recipe),
        held_out=config.evaluation.held_out and config.data.n_held_out > 0,
    )


def build_augmentation(recipe: RecipeConfig) -> Augmentation | None:
    """The augmentation of a recipe; None if it changes nothing."""
    keys = recipe.augmentation.model_dump()
    photometry = Photometry(**{field.name: keys.pop(field.name) for field in fields(Photometry)})
    augmentation = Augmentation(**keys, photometry=photometry)
    return augmentation if augmentation.changes_anything else None


def _source(data: RenderedConfig | FolderConfig | SourceConfig) -> Source:
    if isinstance(data, FolderConfig):
        folder = DetectionFolder(data.folder)
        return FolderSource(folder, data.n_train, data.n_held_out, data.n_test, data.image_size)
    sizes: dict[Part, int] = {"train": data.n_train, "held_out": data.n_held_out, "test": data.n_test}
    if isinstance(data, RenderedConfig):
        return RenderedSource(DatasetFolder(data.folder), data.spec, sizes, data.image_size)
    with naming("data.source", data.source):
        source = instantiate(data.source, _partial_=True)(n=sizes, side=data.image_size)
        if not isinstance(source, Source):
            raise ValueError(f"makes a {type(source).__name__}; expected a phd_exp.data.sources.Source")
        return source


def build_module(config: RunConfig, data: PositionData) -> PositionModule:
    """The network, its loss and its optimizer, initialised from torch's current random state.

    Raises ConfigError, naming the key, for values that a part refuses.
    """
    regressor = build_regressor(config, data.source.depth)
    with naming("optimizer", config.optimizer):
        optimizer = instantiate(config.optimizer, _partial_=True)
        optimizer(regressor.parameters())  # refuses bad values before hours of rendering
    with naming("loss", config.loss):
        # a class makes a loss, a function is one
        loss = instantiate(config.loss, _partial_=not isclass(locate(config.loss["_target_"], None)))
    constant_f = data.source.constant_f if config.camera.focal_length == "constant" else None
    recipe = config.recipe
    if recipe.localisation and not regressor.backbone.locates:
        raise ConfigError(
            f"recipe.localisation: got {recipe.localisation}, but this backbone does not say where the object is; "
            "expected 0, or a backbone that does, as in conf/recipe/strong.yaml"
        )
    schedule = partial(factor, recipe.schedule, recipe.warmup_steps)
    module = PositionModule(regressor, loss, optimizer, constant_f, recipe.localisation, schedule)
    if custom_parts({"head": config.model.head, "backbone": config.backbone, "loss": config.loss}):
        _try_out(module, config, data.source)
    return module


@torch.no_grad()
def _try_out(module: PositionModule, config: RunConfig, source: Source) -> None:
    """Call the user's parts on two black images, before hours of rendering. Raises ConfigError naming the key."""
    side, regressor = config.data.image_size, module.regressor.eval()
    xyz = torch.tensor([[0.0, 0.0, source.depth.z_centre]]).expand(2, 3)
    with naming("backbone", config.backbone):
        output = regressor.see(torch.zeros(2, side, side, 3, dtype=torch.uint8))
        _require(output.features, [(2, regressor.backbone.n_features)])
    with naming("model.head", config.model.head):
        prediction = regressor.prediction(output, Camera(torch.full((2,), source.constant_f), float(side)))
        _require(prediction.mode, [(2, 3)])
    with naming("loss", config.loss):
        _require(module.loss(prediction, xyz), [(2,), ()])
    regressor.train()


def _require(values: Any, shapes: Sequence[tuple[int, ...]]) -> None:
    if not isinstance(values, Tensor) or tuple(values.shape) not in shapes:
        given = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        raise ValueError(f"returned {given} for 2 images; expected {' or '.join(map(str, shapes))}")
    if not values.isfinite().all():
        raise ValueError("returned numbers that are not finite for black images")


def build_trainer(config: RunConfig, recorder: Recorder, callbacks: Sequence[Callback] = ()) -> Trainer:
    """Lightning's Trainer with the callbacks of a run, those of its configuration, and further ones."""
    folder = recorder.folder
    ours: list[Callback] = [
        recorder,
        # at the end of the epoch: a checkpoint taken after the validation leaves the epoch half-counted
        ModelCheckpoint(
            folder.checkpoints, filename="last", enable_version_counter=False, save_on_train_epoch_end=True
        ),
    ]
    if config.trainer.devices == 1:  # several processes would stop at different batches
        ours.append(StopBetweenBatches(folder.last_checkpoint))
    ours += _progress(config)
    arguments: dict[str, Any] = {
        "accelerator": config.trainer.accelerator,
        "devices": config.trainer.devices,
        "strategy": "ddp" if config.trainer.devices > 1 else "auto",
        # not the environment of a cluster, whose tasks are not the processes of a run
        "plugins": [LightningEnvironment(), AtomicCheckpoints()],
        "precision": precision(config.trainer),
        "max_epochs": config.trainer.max_epochs,
        "logger": list(recorder.loggers),
        "callbacks": [*ours, *build_callbacks(config, folder), *callbacks],
        "enable_progress_bar": any(isinstance(callback, ProgressBar) for callback in ours),
        "check_val_every_n_epoch": config.evaluation.every_n_epochs,
        "log_every_n_steps": 1,  # avoids a warning; metrics are logged once an epoch
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
        "default_root_dir": folder.path,
    }
    with naming("trainer", {}):
        return Trainer(**arguments | trainer_arguments(config))


def trainer_arguments(config: RunConfig) -> dict[str, Any]:
    """The arguments of Lightning's Trainer that are no keys of ours.

    Raises ConfigError for one that it does not take, or that the run record depends on.
    """
    given, ours = config.trainer.model_extra or {}, type(config.trainer).model_fields
    known = [*ours, *(key for key in signature(Trainer).parameters if key not in OWNED and key not in ours)]
    for key in given:
        if key in OWNED:
            raise ConfigError(f"trainer.{key}: the run record depends on it; instead {OWNED[key]}")
        if key not in known:
            raise ConfigError(f"trainer.{key}: unknown key{nearest(key, known)}; expected one of {', '.join(known)}")
    return given


def build_callbacks(config: RunConfig, folder: RunFolder) -> list[Callback]:
    """The callbacks of the configuration; a ModelCheckpoint without a folder writes next to the run's own."""
    found = []
    for name, node in config.callbacks.items():
        with naming(f"callbacks.{name}", node):
            callback = instantiate(node)
            if not isinstance(callback, Callback):
                raise ValueError(f"makes a {type(callback).__name__}; expected a lightning.Callback")
        if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
            callback.dirpath = str(folder.checkpoints)
        found.append(callback)
    return found


def _progress(config: RunConfig) -> list[Callback]:
    """A progress bar on a terminal, lines elsewhere, nothing with trainer.progress_bar=false."""
    if not config.trainer.progress_bar:
        return []
    bar = TQDMProgressBar() if on_a_terminal() else None
    return [bar, Progress(bar)] if bar else [Progress()]


def on_a_terminal() -> bool:
    """Whether a progress bar can be drawn."""
    return sys.stderr.isatty()
