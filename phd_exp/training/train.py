"""One run from its configuration to its record: whether it may start, and in how many processes it trains."""

from collections.abc import Sequence
from contextlib import nullcontext, suppress
from functools import partial
from typing import Any

import torch
from lightning import Callback

from phd_exp.build import require_same_shrinking
from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig, RecipeConfig, Render
from phd_exp.config.targets import at_defaults, custom_parts
from phd_exp.data.photometry import VERSION
from phd_exp.hardware import default_threads
from phd_exp.records.choices import first_difference, flatten
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.files import checksum, remove_temporaries
from phd_exp.records.own_images import fingerprint
from phd_exp.records.runs import RunFolder
from phd_exp.training.build import build_augmentation, build_data, build_module
from phd_exp.training.ranks import together
from phd_exp.training.recorder import Draw
from phd_exp.training.run import run
from phd_exp.training.tracking import require_possible_loggers
from phd_exp.training.trainer import build_callbacks, trainer_arguments


def train(
    config: RunConfig,
    folder: RunFolder,
    draw: Draw | None,
    cores: int,
    callbacks: Sequence[Callback] = (),
    overrides: Sequence[str] = (),
    render: Render | None = None,
) -> dict[str, Any]:
    """Render missing data, train, evaluate and record one run; returns its results. A finished run is not repeated.

    An interrupted run resumes with its next batch, a killed one after its last whole epoch.

    Args:
        config: the run.
        folder: the folder of its record.
        draw: draws calibration curves; None records their data alone.
        cores: number of threads, unless trainer.threads or OMP_NUM_THREADS is set.
        callbacks: of Lightning, further ones than the configuration's; with trainer.devices=1 only.
        overrides: words of the command line, for the record.
        render: renders missing samples; None if all are there.

    Raises RunError if the folder holds a run of another configuration or another process uses it, DatasetError if the
    data set is incomplete.
    """
    if render and not folder.is_finished():
        for data in config.rendered:
            render(data)
    with nullcontext() if folder.is_finished() else folder.held():  # that of a finished run may be read-only
        require_same_config(folder, config)
        if folder.is_finished():
            return folder.results()
        for place in (folder.path, folder.checkpoints, folder.calibration):
            remove_temporaries(place)  # of a killed process
        written = config.model_dump(mode="json")
        folder.write_config(written)
        threads = config.trainer.threads or default_threads(cores)
        with folder.recording(_manifest_hash(config.data), custom_parts(written), overrides):
            if (world := config.trainer.devices) > 1:
                results = together(partial(run, config, folder, draw), world, threads)
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
    trainer_arguments(config.trainer)
    require_possible_loggers(config.logger)
    build_callbacks(config.callbacks, folder)
    trainer, found = config.trainer, torch.cuda.device_count()
    if trainer.accelerator == "gpu" and not torch.cuda.is_available():
        raise ConfigError("trainer.accelerator: got 'gpu', but torch sees none here; expected 'cpu' or 'auto'")
    if trainer.accelerator != "cpu" and 0 < found < trainer.devices:
        raise ConfigError(f"trainer.devices: got {trainer.devices}, but torch sees {found} GPUs here")
    for other in (config.several_views, *config.sequences.values(), *map(config.data_of, config.evaluation.shifts)):
        if isinstance(other, RenderedConfig):
            DatasetFolder(other.folder).missing(other.spec, 0, 0)  # refuses another data set in its folder
    build_module(config, build_data(config))


def require_same_config(folder: RunFolder, config: RunConfig) -> None:
    """Raise RunError if the folder holds a run with other results, naming the first key that differs."""
    if not folder.config_file.exists():
        return
    require_same_shrinking(folder, config.data)
    require_same_photometry(folder, config.recipe)
    if difference := _difference(folder, config):
        raise RunError(
            f"{folder.path}: holds a run with {difference} is asked for; "
            "move that folder away, or choose another place by runs=DIR"
        )
    # the user's own data may change under the same name; a rendered set only grows
    status, own = folder.status(), _fingerprint(config.data)
    if own and status and not (status.data_manifest or "").endswith(own):
        where = " and ".join(map(str, config.data.labelled))
        raise RunError(
            f"{folder.path}: holds a run on {where} as it was before its annotations changed; "
            "move that run's folder away, or choose another place by runs=DIR"
        )


def require_same_photometry(folder: RunFolder, recipe: RecipeConfig) -> None:
    """Raise RunError for an interrupted run that trained on images changed by another version of `Photometry`."""
    augmentation = build_augmentation(recipe)
    is_interrupted = folder.last_checkpoint.exists() and not folder.is_finished()
    if not is_interrupted or augmentation is None or not augmentation.photometry.changes_anything:
        return
    constants = folder.constants() if folder.constants_file.exists() else {}
    if constants.get("photometry") != VERSION:
        raise RunError(
            f"{folder.path}: interrupted while it trained with light, blur, noise or JPEG of an earlier version, "
            "whose images differ; move the folder away and train again"
        )


def _difference(folder: RunFolder, config: RunConfig) -> str | None:
    """The first key with another value in the run that a folder holds; None if its results are the same."""
    whole = config.model_dump(mode="json")
    asked = flatten(whole)
    chosen = flatten(config.model_dump(mode="json", exclude_defaults=True))
    # may be absent in an older record
    younger = {key: value for key, value in asked.items() if key not in chosen} | at_defaults(whole)
    return first_difference(younger | flatten(folder.config()), asked)


def equal_run(config: RunConfig, folder: RunFolder) -> RunFolder | None:
    """A finished run next to a folder with the same configuration: other overrides can lead to equal values."""
    for path in sorted(folder.path.parent.glob(f"seed{config.seed}*")):
        with suppress(RunError):  # a record that cannot be read
            if path != folder.path and (other := RunFolder(path)).is_finished() and not _difference(other, config):
                return other
    return None


def _manifest_hash(data: DataConfig) -> str | None:
    """Checksum of the data set's manifest, and of the annotations of the user's own images, if there are any."""
    own = _fingerprint(data)
    if not isinstance(data, RenderedConfig):
        return own
    with suppress(OSError):  # the data of a finished run may be gone
        manifest = checksum(DatasetFolder(data.folder).manifest_path)
        return f"{manifest}+{own}" if own else manifest
    return None


def _fingerprint(data: DataConfig) -> str | None:
    """Checksum of the annotations of the user's own images, if there are any."""
    with suppress(OSError):
        return fingerprint(*data.labelled) if data.labelled else None
    return None
