"""Builds the objects of a checked configuration; `network.py` builds the network."""

import sys
from dataclasses import fields
from functools import partial

from hydra.utils import instantiate
from lightning import Trainer
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, ProgressBar, TQDMProgressBar

from phd_exp.data.augmentation import Augmentation
from phd_exp.data.datamodule import PositionData
from phd_exp.data.folder import FolderSource
from phd_exp.data.photometry import Photometry
from phd_exp.data.sources import Part, RenderedSource, Source
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.detections import DetectionFolder
from phd_exp.records.errors import ConfigError
from phd_exp.training.checkpoints import AtomicCheckpoints, StopBetweenBatches
from phd_exp.training.config import FolderConfig, RenderedConfig, RunConfig
from phd_exp.training.config.sections import RecipeConfig
from phd_exp.training.module import PositionModule, factor
from phd_exp.training.network import build_regressor, naming, precision
from phd_exp.training.progress import Progress
from phd_exp.training.recorder import Recorder


def build_data(config: RunConfig, rank: int = 0) -> PositionData:
    """The data set of a run, or of one of its processes. `setup` opens the images."""
    return PositionData(
        _source(config.data),
        batch_size=config.data.batch_size,
        seed=config.seed,
        rank=rank,
        world=config.trainer.devices,
        augment=build_augmentation(config.recipe),
    )


def build_augmentation(recipe: RecipeConfig) -> Augmentation | None:
    """The augmentation of a recipe; None if it changes nothing."""
    keys = recipe.augmentation.model_dump()
    photometry = Photometry(**{field.name: keys.pop(field.name) for field in fields(Photometry)})
    augmentation = Augmentation(**keys, photometry=photometry)
    return augmentation if augmentation.changes_anything else None


def _source(data: RenderedConfig | FolderConfig) -> Source:
    if isinstance(data, FolderConfig):
        folder = DetectionFolder(data.folder)
        return FolderSource(folder, data.n_train, data.n_held_out, data.n_test, data.image_size)
    sizes: dict[Part, int] = {"train": data.n_train, "held_out": data.n_held_out, "test": data.n_test}
    return RenderedSource(DatasetFolder(data.folder), data.spec, sizes, data.image_size)


def build_module(config: RunConfig, data: PositionData) -> PositionModule:
    """The network, its loss and its optimizer, initialised from torch's current random state.

    Raises ConfigError, naming the key, for values that a part refuses.
    """
    regressor = build_regressor(config, data.source.depth)
    with naming("optimizer"):
        optimizer = instantiate(config.optimizer, _partial_=True)
        optimizer(regressor.parameters())  # refuses bad values before hours of rendering
    constant_f = data.source.constant_f if config.camera.focal_length == "constant" else None
    recipe = config.recipe
    if recipe.localisation and not regressor.backbone.locates:
        raise ConfigError(
            f"recipe.localisation: got {recipe.localisation}, but this backbone does not say where the object is; "
            "expected 0, or a backbone that does, as in conf/recipe/strong.yaml"
        )
    return PositionModule(
        regressor,
        instantiate(config.loss),
        optimizer,
        constant_f,
        recipe.localisation,
        partial(factor, recipe.schedule, recipe.warmup_steps),
    )


def build_trainer(config: RunConfig, recorder: Recorder) -> Trainer:
    """Lightning's Trainer with the callbacks of a run."""
    folder = recorder.folder
    callbacks: list[Callback] = [
        recorder,
        # at the end of the epoch: a checkpoint taken after the validation leaves the epoch half-counted
        ModelCheckpoint(
            folder.checkpoints, filename="last", enable_version_counter=False, save_on_train_epoch_end=True
        ),
    ]
    if config.trainer.devices == 1:  # several processes would stop at different batches
        callbacks.append(StopBetweenBatches(folder.last_checkpoint))
    callbacks += _progress(config)
    return Trainer(
        accelerator=config.trainer.accelerator,
        devices=config.trainer.devices,
        strategy="ddp" if config.trainer.devices > 1 else "auto",
        # not the environment of a cluster, whose tasks are not the processes of a run
        plugins=[LightningEnvironment(), AtomicCheckpoints()],
        precision=precision(config.trainer),
        max_epochs=config.trainer.max_epochs,
        logger=list(recorder.loggers),
        callbacks=callbacks,
        enable_progress_bar=any(isinstance(callback, ProgressBar) for callback in callbacks),
        check_val_every_n_epoch=config.evaluation.every_n_epochs,
        log_every_n_steps=1,  # avoids a warning; metrics are logged once an epoch
        enable_model_summary=False,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        default_root_dir=folder.path,
    )


def _progress(config: RunConfig) -> list[Callback]:
    """A progress bar on a terminal, lines elsewhere, nothing with trainer.progress_bar=false."""
    if not config.trainer.progress_bar:
        return []
    bar = TQDMProgressBar() if on_a_terminal() else None
    return [bar, Progress(bar)] if bar else [Progress()]


def on_a_terminal() -> bool:
    """Whether a progress bar can be drawn."""
    return sys.stderr.isatty()
