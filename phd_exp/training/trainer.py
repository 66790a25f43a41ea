"""Lightning's Trainer for a run: its arguments, its callbacks, and those of the user."""

from collections.abc import Mapping, Sequence
from inspect import signature
from typing import Any

from lightning import Trainer
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, ProgressBar

from phd_exp.build import naming
from phd_exp.config import RunConfig
from phd_exp.config.sections import TrainerConfig
from phd_exp.config.targets import build
from phd_exp.hardware import precision
from phd_exp.records.errors import ConfigError, shown, unknown
from phd_exp.records.runs import RunFolder
from phd_exp.training.checkpoints import AtomicCheckpoints, StopBetweenBatches
from phd_exp.training.progress import Progress
from phd_exp.training.recorder import Recorder

INSTEAD = {
    "set callbacks=NAME, or +callbacks.NAME._target_=CLASS; runs resume from their own checkpoints": (
        "callbacks", "enable_checkpointing",
    ),
    "set logger=NAME, or +logger.NAME._target_=CLASS": ("logger",),
    "set evaluation.every_n_epochs, since the record has one row an epoch": (
        "check_val_every_n_epoch", "val_check_interval",
    ),
    "set trainer.progress_bar": ("enable_progress_bar",),
    "set runs": ("default_root_dir",),
    "set trainer.max_epochs=1 +trainer.limit_train_batches=1, which leaves a checkpoint": ("fast_dev_run",),
    "set data.n_test, since the record has all test samples": ("limit_predict_batches",),
    "set trainer.devices, since all processes are on one machine": ("strategy", "num_nodes"),
    "leave it out": (
        "num_sanity_val_steps", "use_distributed_sampler", "reload_dataloaders_every_n_epochs", "plugins",
        "barebones",
    ),
}  # fmt: skip
"""What to do instead of setting arguments of Lightning's Trainer that the run record depends on."""
OWNED = {key: words for words, keys in INSTEAD.items() for key in keys}


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
    theirs = [*build_callbacks(config.callbacks, folder), *callbacks]
    has_bar = any(isinstance(callback, ProgressBar) for callback in theirs)
    if config.trainer.progress_bar and not has_bar:
        ours.append(Progress())
    arguments: dict[str, Any] = {
        "accelerator": config.trainer.accelerator,
        "devices": config.trainer.devices,
        "strategy": "ddp" if config.trainer.devices > 1 else "auto",
        # not the environment of a cluster, whose tasks are not the processes of a run
        "plugins": [LightningEnvironment(), AtomicCheckpoints(folder)],
        "precision": precision(config.trainer.accelerator, config.trainer.precision),
        "max_epochs": config.trainer.max_epochs,
        "logger": list(recorder.loggers),
        "callbacks": [*ours, *theirs],
        "enable_progress_bar": config.trainer.progress_bar or has_bar,
        "check_val_every_n_epoch": config.evaluation.every_n_epochs,
        "log_every_n_steps": 1,  # avoids a warning; metrics are logged once an epoch
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
        "default_root_dir": folder.path,
    }
    with naming("trainer", {}):
        return Trainer(**arguments | trainer_arguments(config.trainer))


def trainer_arguments(trainer: TrainerConfig) -> dict[str, Any]:
    """The arguments of Lightning's Trainer that are no keys of ours.

    Raises ConfigError for one that it does not take, or that the run record depends on.
    """
    given, ours = trainer.model_extra or {}, TrainerConfig.model_fields
    known = [*ours, *(key for key in signature(Trainer).parameters if key not in OWNED and key not in ours)]
    for key in given:
        if key in OWNED:
            raise ConfigError(f"trainer.{key}: the run record depends on it; instead {OWNED[key]}")
        if key not in known:
            raise ConfigError(unknown(f"trainer.{key}", known))
    return given


def build_callbacks(nodes: Mapping[str, Any], folder: RunFolder) -> list[Callback]:
    """The callbacks of the configuration; those that write checkpoints write next to the run's own.

    Raises ConfigError for what is no callback, and for one that writes elsewhere.
    """
    found = []
    for name, node in nodes.items():
        with naming(f"callbacks.{name}", node):
            callback = build(node)
            if not isinstance(callback, Callback):
                raise ValueError(f"makes a {type(callback).__name__}; expected a lightning.Callback")
        if getattr(callback, "dirpath", None) is not None:
            raise ConfigError(
                f"callbacks.{name}.dirpath: got {shown(node.get('dirpath'))}; expected null, since checkpoints are "
                "written to the folder of the run"
            )
        if hasattr(callback, "dirpath"):
            callback.dirpath = str(folder.checkpoints.resolve())
        found.append(callback)
    return found
