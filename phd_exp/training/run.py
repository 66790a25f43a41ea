"""One run from its configuration to its record."""

import logging
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from lightning import Trainer, seed_everything

from phd_exp.data.datamodule import PositionData
from phd_exp.data.images import SHRINKING
from phd_exp.data.sources import Part
from phd_exp.distributions.columns import Columns
from phd_exp.records.choices import flatten, has_influence
from phd_exp.records.dataset import DatasetFolder, checksum
from phd_exp.records.detections import DetectionFolder
from phd_exp.records.errors import ConfigError, RunError, shown
from phd_exp.records.files import remove_temporaries
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_data, build_module, build_trainer
from phd_exp.training.config import FolderConfig, RunConfig, TrainerConfig
from phd_exp.training.module import PositionModule
from phd_exp.training.predictions import summary, write_parquet
from phd_exp.training.ranks import train_together
from phd_exp.training.recorder import Draw, Recorder
from phd_exp.training.stored import ADVICE, load_checkpoint, require_same_shrinking
from phd_exp.training.tracking import require_key, tracked

UNTRAINED = -1
"""The epoch before the first: what the untrained network gives."""


def train(config: RunConfig, folder: RunFolder, draw: Draw | None, cores: int) -> dict[str, Any]:
    """Train, measure and record one run; returns its results. A finished run is not run again.

    A run that was stopped goes on with its next batch, one that was killed after its last whole epoch.

    Args:
        config: what to run.
        folder: where its record goes.
        draw: draws calibration curves; None records them alone.
        cores: how many threads it has, unless trainer.threads says otherwise.

    Raises RunError where the folder holds a run of another configuration or another process works on it, DatasetError
    where the data set is incomplete.
    """
    with folder.held():
        require_same_config(folder, config)
        if folder.is_finished():
            return folder.results()
        for place in (folder.path, folder.checkpoints, folder.calibration):
            remove_temporaries(place)  # of a process that was killed
        folder.write_config(config.model_dump(mode="json"))
        threads = config.trainer.threads or cores
        with folder.recording(data_manifest=_manifest_hash(config)):
            if config.trainer.devices > 1:
                results = train_together(config, folder.path, draw, threads)
            else:
                results = run(config, folder, draw, threads)
            folder.write_results(results)
    return folder.results()


def require_possible(config: RunConfig, folder: RunFolder) -> None:
    """Raise, before anything is rendered or written, what would stop the run later.

    RunError: the folder holds a run of another configuration, or cannot be written. ConfigError: there is no GPU, no
    key of wandb, or a part of the model refuses its values.
    """
    require_same_config(folder, config)
    folder.require_writable()
    require_key(config.logger)
    if config.trainer.accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError(
            "trainer.accelerator: got 'gpu', but torch sees none here; expected 'cpu' or 'auto'"
        )
    _require_devices(config.trainer)
    build_module(config, build_data(config))


def _require_devices(trainer: TrainerConfig) -> None:
    found = torch.cuda.device_count()
    if trainer.accelerator != "cpu" and 0 < found < trainer.devices:
        raise ConfigError(f"trainer.devices: got {trainer.devices}, but torch sees {found} GPUs here")


def require_same_config(folder: RunFolder, config: RunConfig) -> None:
    """Raise RunError where the folder holds a run that computes something else, naming the first key."""
    if not folder.config_file.exists():
        return
    require_same_shrinking(folder, config)
    recorded, asked = flatten(folder.config()), flatten(config.model_dump(mode="json"))
    for key in sorted(recorded.keys() | asked.keys()):
        before, now = recorded.get(key, "nothing"), asked.get(key, "nothing")
        if before != now and has_influence(key):
            raise RunError(
                f"{folder.path}: holds a run with {key}={before}, but {key}={now} is asked for; "
                "move that folder away, or choose another place by runs=DIR"
            )
    _require_same_data(folder, config)


def _require_same_data(folder: RunFolder, config: RunConfig) -> None:
    """The user's own data may be another under the same name; a rendered set that differs is no more than longer."""
    status = folder.status()
    if isinstance(config.data, FolderConfig) and status is not None:
        recorded, now = status.data_manifest, _manifest_hash(config)
        if now is not None and recorded != now:
            raise RunError(
                f"{folder.path}: holds a run on {config.data.folder} as it was before its metadata.jsonl changed; "
                "move that run's folder away, or choose another place by runs=DIR"
            )


def run(
    config: RunConfig, folder: RunFolder, draw: Draw | None, threads: int, rank: int = 0
) -> dict[str, Any]:
    """What one process does of a run: all of it, or its share where several train together (`ranks.py`).

    Returns the results. Of several processes, all compute them and the first (`rank` 0) alone writes the record.
    """
    _quiet_lightning()
    torch.set_num_threads(threads)
    seed_everything(config.seed, verbose=False)
    data = build_data(config, rank)
    data.setup()
    if rank == 0:
        constants = asdict(data.source.depth) | {"constant_f": data.source.constant_f}
        folder.write_constants(constants | {"shrinking": SHRINKING})
    module = build_module(config, data)
    with tracked(config, folder) if rank == 0 else nullcontext() as logger:
        recorder = Recorder(folder, config.evaluation, draw, [logger] if logger else [])
        trainer = build_trainer(config, recorder)
        checkpoint = _take_up(trainer, module, data, recorder)
        recorder.send_recorded()
        _fit(trainer, module, data, checkpoint, recorder)
        tables: dict[Part, Columns] = {
            part: _evaluate(trainer, module, data, part) for part in data.samples if part != "train"
        }
        results = summary(tables["test"]) | _untrained(recorder) | _circumstances(config, data, trainer)
        if trainer.is_global_zero:
            recorder.record_curves("final", tables["test"], trainer.global_step)
            _write_tables(folder, tables, data)
        if logger:
            logger.experiment.summary.update(results)
    return results


def _write_tables(folder: RunFolder, tables: Mapping[Part, Columns], data: PositionData) -> None:
    for part, table in tables.items():
        file = folder.held_out if part == "held_out" else folder.predictions
        write_parquet(file, table, data.source.known(part))


def _take_up(trainer: Trainer, module: PositionModule, data: PositionData, recorder: Recorder) -> Path | None:
    """Leave in the record what was done before: the epochs up to the last checkpoint, which is returned.

    A new run has none; what its untrained network gives is recorded.
    """
    checkpoint = recorder.folder.last_checkpoint
    if checkpoint.exists():
        epochs = trainer.max_epochs or 0
        last = _last_whole_epoch(checkpoint, epochs, len(data.train_dataloader()))
        recorder.forget_after(last)
        _require_recorded(recorder, checkpoint)
        if trainer.is_global_zero and last + 1 < epochs:
            print(f"{recorder.folder.path}: resuming at epoch {last + 2} of {epochs}", flush=True)
        return checkpoint
    recorder.forget_after(UNTRAINED)
    recorder.record(UNTRAINED, summary(_evaluate(trainer, module, data, "test")), step=0)
    return None


def _require_recorded(recorder: Recorder, checkpoint: Path) -> None:
    """Raise RunError unless the epochs before a checkpoint are recorded with their numbers."""
    untrained = recorder.rows.get(UNTRAINED, {})
    numbers = [value for row in recorder.rows.values() for value in row.values()]
    if not any(key.startswith("test/") for key in untrained) or not all(map(_is_number, numbers)):
        raise RunError(
            f"{recorder.folder.metrics_file}: not the record of the epochs before {checkpoint.name}; "
            "delete both to begin the run again"
        )


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _fit(
    trainer: Trainer, module: PositionModule, data: PositionData, checkpoint: Path | None, recorder: Recorder
) -> None:
    """Train to the last epoch, from the checkpoint if there is one.

    Raises RunError if the checkpoint is one of another run.
    """
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except (KeyError, ValueError, TypeError, AttributeError, RuntimeError, IndexError) as error:
        if checkpoint is None or recorder.begun:
            raise
        reason = " ".join(str(error).split())[:120]
        raise RunError(f"{checkpoint}: not a checkpoint of this run ({reason}); {ADVICE}") from None


def _untrained(recorder: Recorder) -> dict[str, Any]:
    """The numbers of the untrained network, for comparison."""
    return {f"untrained/{key}": value for key, value in recorder.rows[UNTRAINED].items() if "test/" in key}


def _last_whole_epoch(checkpoint: Path, epochs: int, batches: int) -> int:
    """The last epoch that a checkpoint has seen whole. Raises RunError where it is none of a run so long."""
    content = load_checkpoint(checkpoint)
    epoch = content.get("epoch")
    if type(epoch) is not int or not 0 <= epoch < epochs:
        raise RunError(
            f"{checkpoint}: not a checkpoint of this run (epoch {shown(epoch)} of {epochs}); {ADVICE}"
        )
    place = content.get(PositionData.__qualname__)
    is_whole = not isinstance(place, dict) or place.get("next_batch") == batches
    return epoch if is_whole else epoch - 1


def _evaluate(trainer: Trainer, module: PositionModule, data: PositionData, part: Part) -> Columns:
    """Predictions of the present weights, a row a sample, from all processes."""
    trainer.predict(module, dataloaders=data.in_order(part), return_predictions=False)
    return module.table


def _circumstances(config: RunConfig, data: PositionData, trainer: Trainer) -> dict[str, Any]:
    return {
        "preset": config.preset,
        "recipe": config.recipe.name,
        "data": config.data.name,
        "model": config.model.name,
        "seed": config.seed,
        "n_train": data.source.count("train"),
        "n_held_out": data.source.count("held_out"),
        "n_test": data.source.count("test"),
        "epochs": trainer.current_epoch,
        "devices": trainer.world_size,
        "threads": torch.get_num_threads(),  # of each process
        "device": str(trainer.strategy.root_device),
        "precision": str(trainer.precision),
    }


def _manifest_hash(config: RunConfig) -> str | None:
    if isinstance(config.data, FolderConfig):
        try:
            return DetectionFolder(config.data.folder).fingerprint()
        except OSError:  # the data of a finished run may have gone
            return None
    manifest = DatasetFolder(config.data.folder).manifest_path
    return checksum(manifest) if manifest.is_file() else None


def _quiet_lightning() -> None:
    """Leave the terminal to this programme's own lines, and say nothing of what is meant."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # Lightning calls an old name of torch
    warnings.filterwarnings("ignore", ".*LeafSpec.*is deprecated", FutureWarning)
    # a run that was broken off goes on in its own folder
    warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
    # what is logged are sums over all processes already
    warnings.filterwarnings("ignore", "It is recommended to use .*sync_dist=True")
