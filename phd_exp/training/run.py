"""One run from its configuration to its record."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import torch
from lightning import Callback, Trainer, seed_everything

from phd_exp.data.datamodule import PositionData
from phd_exp.data.images import SHRINKING
from phd_exp.data.sources import PARTS, Part
from phd_exp.distributions.columns import Columns
from phd_exp.records.choices import first_difference, flatten
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, RunError, gist, shown
from phd_exp.records.files import checksum, remove_temporaries
from phd_exp.records.own_images import DetectionFolder
from phd_exp.records.runs import RunFolder
from phd_exp.threads import default_threads
from phd_exp.training.build import build_data, build_module
from phd_exp.training.config import FolderConfig, RenderedConfig, RunConfig
from phd_exp.training.config.targets import custom_parts
from phd_exp.training.module import PositionModule
from phd_exp.training.network import ADVICE, load_checkpoint, require_same_shrinking
from phd_exp.training.predictions import summary, write_parquet
from phd_exp.training.ranks import train_together
from phd_exp.training.recorder import Draw, Recorder
from phd_exp.training.tracking import require_possible_loggers, send_results, tracked
from phd_exp.training.trainer import build_callbacks, build_trainer, trainer_arguments

UNTRAINED = -1  # the number of the epoch before the first, whose metrics are those of the untrained network


def train(
    config: RunConfig,
    folder: RunFolder,
    draw: Draw | None,
    cores: int,
    callbacks: Sequence[Callback] = (),
    overrides: Sequence[str] = (),
) -> dict[str, Any]:
    """Train, evaluate and record one run; returns its results. A finished run is not run again.

    An interrupted run resumes with its next batch, a killed one after its last whole epoch.

    Args:
        config: the run.
        folder: the folder of its record.
        draw: draws calibration curves; None records their data alone.
        cores: number of threads, unless trainer.threads or OMP_NUM_THREADS is set.
        callbacks: of Lightning, further ones than the configuration's; with trainer.devices=1 only.
        overrides: words of the command line, for the record.

    Raises RunError if the folder holds a run of another configuration or another process uses it, DatasetError if the
    data set is incomplete.
    """
    with folder.held():
        require_same_config(folder, config)
        if folder.is_finished():
            return folder.results()
        for place in (folder.path, folder.checkpoints, folder.calibration):
            remove_temporaries(place)  # of a killed process
        folder.write_config(config.model_dump(mode="json"))
        threads = config.trainer.threads or default_threads(cores)
        with folder.recording(_manifest_hash(config), custom_parts(config.model_dump(mode="json")), overrides):
            if config.trainer.devices > 1:
                results = train_together(config, folder.path, draw, threads)
            else:
                results = run(config, folder, draw, threads, callbacks=callbacks)
            folder.write_results(results)
    return folder.results()


def require_possible(config: RunConfig, folder: RunFolder) -> None:
    """Raise the errors that would stop the run later, before anything is rendered or written.

    RunError: the folder holds a run of another configuration, or cannot be written. ConfigError: no GPU, no key of
    wandb, or values that a part of the model or the data of a shift refuses. DatasetError: the folder of several
    views or of a shift's data holds other data.
    """
    require_same_config(folder, config)
    folder.require_writable()
    trainer_arguments(config)
    require_possible_loggers(config.logger)
    build_callbacks(config, folder)
    trainer, found = config.trainer, torch.cuda.device_count()
    if trainer.accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("trainer.accelerator: got 'gpu', but torch sees none here; expected 'cpu' or 'auto'")
    if trainer.accelerator != "cpu" and 0 < found < trainer.devices:
        raise ConfigError(f"trainer.devices: got {trainer.devices}, but torch sees {found} GPUs here")
    for other in (config.several_views, *map(config.data_of, config.evaluation.shifts)):
        if isinstance(other, RenderedConfig):
            DatasetFolder(other.folder).missing(other.spec, 0, 0)  # refuses another data set in its folder
    build_module(config, build_data(config))


def require_same_config(folder: RunFolder, config: RunConfig) -> None:
    """Raise RunError if the folder holds a run with other results, naming the first key that differs."""
    if not folder.config_file.exists():
        return
    require_same_shrinking(folder, config)
    if difference := _difference(folder, config):
        raise RunError(
            f"{folder.path}: holds a run with {difference} is asked for; "
            "move that folder away, or choose another place by runs=DIR"
        )
    # the user's own data may change under the same name; a rendered set only grows
    status, manifest = folder.status(), _manifest_hash(config)
    if isinstance(config.data, FolderConfig) and status and manifest not in (None, status.data_manifest):
        raise RunError(
            f"{folder.path}: holds a run on {config.data.folder} as it was before its annotations changed; "
            "move that run's folder away, or choose another place by runs=DIR"
        )


def _difference(folder: RunFolder, config: RunConfig) -> str | None:
    """The first key with another value in the run that a folder holds; None if its results are the same."""
    asked = flatten(config.model_dump(mode="json"))
    chosen = flatten(config.model_dump(mode="json", exclude_defaults=True))
    younger = {key: value for key, value in asked.items() if key not in chosen}  # may be absent in an older record
    return first_difference(younger | flatten(folder.config()), asked)


def equal_run(config: RunConfig, folder: RunFolder) -> RunFolder | None:
    """A finished run next to a folder with the same configuration: other overrides can lead to equal values."""
    for path in sorted(folder.path.parent.glob(f"seed{config.seed}*")):
        with suppress(RunError):  # a record that cannot be read
            if path != folder.path and (other := RunFolder(path)).is_finished() and not _difference(other, config):
                return other
    return None


def run(
    config: RunConfig,
    folder: RunFolder,
    draw: Draw | None,
    threads: int,
    rank: int = 0,
    callbacks: Sequence[Callback] = (),
) -> dict[str, Any]:
    """Run in this process: the whole run, or one rank of several that train together (`ranks.py`).

    Every rank computes and returns the results; rank 0 alone writes the record.
    """
    quiet_lightning()
    torch.set_num_threads(threads)
    seed_everything(config.seed, verbose=False)
    data = build_data(config, rank)
    data.setup()
    if rank == 0:
        constants = asdict(data.source.depth) | {"constant_f": data.source.constant_f}
        folder.write_constants(constants | {"shrinking": SHRINKING})
    module = build_module(config, data)
    with tracked(config, folder, rank) as loggers:
        recorder = Recorder(folder, config.evaluation, draw, loggers)
        trainer = build_trainer(config, recorder, callbacks)
        _fit(trainer, module, data, recorder)
        if not folder.last_checkpoint.exists():
            raise RunError(
                f"{folder.path}: trained no whole epoch, so there is no run; set other arguments of trainer"
            )
        if (best := folder.best_checkpoint) != folder.last_checkpoint:
            module.load_state_dict(load_checkpoint(best)["state_dict"])
        tables = {part: _evaluate(trainer, module, data, part) for part in data.samples if part != "train"}
        untrained = recorder.rows[UNTRAINED].items()
        results = summary(tables["test"])
        results |= {f"untrained/{key}": value for key, value in untrained if "test/" in key}
        results |= _circumstances(config, data, trainer)
        if rank == 0:
            recorder.record_curves("final", tables["test"], trainer.global_step)
            for part, table in tables.items():
                file = folder.held_out if part == "held_out" else folder.predictions
                write_parquet(file, table, data.source.known(part))
        send_results(loggers, results)
    return results


def _fit(trainer: Trainer, module: PositionModule, data: PositionData, recorder: Recorder) -> None:
    """Train to the last epoch, from the last checkpoint if there is one.

    A new run has none; the metrics of its untrained network are recorded first.

    Raises RunError if the checkpoint, or the record of the epochs before it, does not belong to this run.
    """
    checkpoint = recorder.folder.last_checkpoint
    if not checkpoint.exists():
        recorder.forget_after(UNTRAINED)
        recorder.record(UNTRAINED, summary(_evaluate(trainer, module, data, "test")), step=0)
        recorder.send_recorded()
        trainer.fit(module, datamodule=data)
        return
    content, epochs = load_checkpoint(checkpoint), trainer.max_epochs or 0
    epoch = content.get("epoch")
    if type(epoch) is not int or not 0 <= epoch < epochs:
        raise RunError(f"{checkpoint}: not a checkpoint of this run (epoch {shown(epoch)} of {epochs}); {ADVICE}")
    is_whole = _ends_an_epoch(content)
    recorder.forget_after(epoch if is_whole else epoch - 1)
    if not any(key.startswith("test/") for key in recorder.rows.get(UNTRAINED, {})):
        raise RunError(
            f"{recorder.folder.metrics_file}: not the record of the epochs before {checkpoint.name}; "
            "delete both to begin the run again"
        )
    if trainer.is_global_zero and epoch + is_whole < epochs:
        print(f"{recorder.folder.path}: resuming at epoch {epoch + is_whole + 1} of {epochs}", flush=True)
    recorder.send_recorded()
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except (KeyError, ValueError, TypeError, AttributeError, RuntimeError, IndexError) as error:
        if recorder.begun:
            raise
        raise RunError(f"{checkpoint}: not a checkpoint of this run ({gist(error)}); {ADVICE}") from None


def _ends_an_epoch(checkpoint: Mapping[str, Any]) -> bool:
    """Whether a checkpoint was taken after the last batch of an epoch, as Lightning records it."""
    try:
        return bool(checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]["is_last_batch"])
    except (KeyError, TypeError):
        return True


def _evaluate(trainer: Trainer, module: PositionModule, data: PositionData, part: Part) -> Columns:
    """Predictions of the current weights for all samples of a part, gathered from all processes."""
    trainer.predict(module, dataloaders=data.in_order(part), return_predictions=False)
    return module.table


def _circumstances(config: RunConfig, data: PositionData, trainer: Trainer) -> dict[str, Any]:
    return {
        "preset": config.preset,
        "recipe": config.recipe.name,
        "data": config.data.name,
        "model": config.model.name,
        "seed": config.seed,
        **{f"n_{part}": data.source.count(part) for part in PARTS},
        "epochs": trainer.current_epoch,
        "devices": trainer.world_size,
        "threads": torch.get_num_threads(),  # of each process
        "device": _name_of(trainer.strategy.root_device),
        "precision": str(trainer.precision),
    }


def _name_of(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)


def _manifest_hash(config: RunConfig) -> str | None:
    with suppress(OSError):  # the data of a finished run may be gone
        if isinstance(config.data, FolderConfig):
            return DetectionFolder(config.data.folder).fingerprint()
        if isinstance(config.data, RenderedConfig):
            return checksum(DatasetFolder(config.data.folder).manifest_path)
    return None


def quiet_lightning() -> None:
    """Silence Lightning's remarks, except a profiler's, and the warnings about intended behaviour."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.INFO)
    # Lightning calls a deprecated name of torch
    warnings.filterwarnings("ignore", ".*LeafSpec.*is deprecated", FutureWarning)
    warnings.filterwarnings("ignore", "Precision .* is not supported by the model summary")
    # an interrupted run resumes in the same folder
    warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
    # the first steps are timed without an evaluation
    warnings.filterwarnings("ignore", "You defined a `validation_step` but have no `val_dataloader`")
    # the logged values are already sums over all processes
    warnings.filterwarnings("ignore", "It is recommended to use .*sync_dist=True")
