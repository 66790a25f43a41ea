"""`python -m phd_exp [train]`: render missing data, train, measure and record a run."""

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override

from phd_exp.cli import words
from phd_exp.cli.jobs import Job, composed, launch
from phd_exp.config import RenderedConfig, RunConfig, check
from phd_exp.config.targets import is_ours
from phd_exp.records.choices import RunName, has_influence, setting
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, RunError, shown
from phd_exp.records.processes import usable_cores
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import Shard
from phd_exp.rendering.render import FEWER, ensure_rendered

if TYPE_CHECKING:
    from phd_exp.inference.trained import TrainedRun

NAMED = ("preset", "recipe", "data", "data.name", "model", "seed", "experiment", "shift")
"""Choices with a place of their own in a run's name, and groups that change no weight."""
SHOWN = (
    "test/projected_error_mm",
    "test/depth_error_mm",
    "test/nll",
    "test/calibration/depth_ence",
    "test/calibration/projected_ence",
    "test/calibration/miscalibration_area",
)
"""The numbers that are printed at the end of a run; results.json holds more."""
SUMMARY = {
    "test/projected_error_mm": "projected error {} mm",
    "test/depth_error_mm": "depth error {} mm",
    "test/nll": "NLL {}",
}
"""The numbers of each run at the end of a sweep."""
OF_NETWORK = ("backbone", "camera", "recipe.hidden", "recipe.exposure", "data.image_size")
"""The sections and keys that describe a network and its inputs."""
UNREADABLE = (KeyError, TypeError, AttributeError, OSError, RunError)
"""The errors of a configuration that is not checked, and of a record that cannot be read."""


def main(line: list[str]) -> int:
    """Train once, or (-m) for every combination; returns the exit status."""
    return launch(Job(task, standing, numbers), line)


def task(config: dict[str, Any], overrides: list[str], cores: int, callbacks: Sequence[Any] = ()) -> float | None:
    """Render missing data, train one run and print its numbers; returns its score, None without held-out samples.

    `callbacks` are Lightning's, in addition to those of the configuration.
    """
    checked = checked_start(config, overrides)
    # imports of seconds, which follow the check of the configuration
    from phd_exp.training.pruning import held_out_score
    from phd_exp.training.tables import record_tables
    from phd_exp.training.train import require_possible, train

    folder, render = RunFolder(run_name(checked, overrides).folder(checked.runs)), partial(rendered, cores=cores)
    skipped = folder.is_finished()
    if not skipped:
        require_possible(checked, folder)
        announce(checked, folder, overrides)
    own = [str(item.input_line) for item in _unnamed(overrides)]
    results = train(checked, folder, _draw(), cores, callbacks, own, render)
    record_tables(folder, checked, render)
    print(f"{folder.path}: {'finished already' if skipped else 'finished'}")
    for key in filter(results.__contains__, SHOWN):
        print(f"  {key} {_number(results[key])} (untrained {_number(results.get(f'untrained/{key}'))})")
    if (folder.calibration / "final.png").exists():
        print(f"  calibration curves: {folder.calibration / 'final.png'}")
    return held_out_score(folder.path)[1] if folder.held_out.exists() else None


def trained(overrides: Sequence[str], config_dir: str | Path | None) -> "TrainedRun":
    """Train one run from Python; see `phd_exp.train`."""
    from phd_exp.inference.trained import TrainedRun

    if isinstance(overrides, str):
        raise ConfigError(
            f"overrides: got {shown(overrides)}; expected a list of words, such as [{shown(overrides)}]"
        )
    own = words.overrides(overrides)
    config = composed(own, config_dir)
    task(config, own, usable_cores())
    return TrainedRun(run_name(checked_start(config, own), own).folder(Path(config["runs"])))


def checked_start(config: dict[str, Any], overrides: list[str]) -> RunConfig:
    """The checked configuration of a training, with the network of the run that it starts from (`init=`), if any.

    What the command line names stays. Raises ConfigError if the configuration is wrong, if that run is not finished,
    or if its network is not of this project: such a network is only built if the command line names it.
    """
    place = config.get("init")  # the configuration alone may have larger images than it renders: not checked before
    if not place or not isinstance(place, str):
        return check(config)
    start = RunFolder(Path(place))
    if not start.is_finished():
        raise ConfigError(f"init: got {place}; expected the folder of a finished run")
    try:
        changed = _with_network_of(start.config(), config, overrides)
    except (KeyError, TypeError):
        raise RunError(f"{start.config_file}: not the configuration of a run") from None
    if changed["backbone"] is not config["backbone"] and not is_ours(changed["backbone"]):
        raise ConfigError(
            f"init: the network of {place} is not of this project; name it by backbone=CHOICE, or by "
            "backbone._target_=MODULE.NAME"
        )
    return check(changed)


def _with_network_of(recorded: dict[str, Any], config: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """A configuration with the recorded network, except for what the command line names."""
    changed = dict(config)
    named = [f"{words.parsed(word).key_or_group}." for word in overrides]
    for name in OF_NETWORK:
        section, _, key = name.partition(".")
        if any(word.startswith(f"{name}.") for word in named):
            continue
        if not key:
            changed[section] = recorded[section]
            continue
        changed[section] = {word: value for word, value in changed[section].items() if word != key}
        if key in recorded[section]:  # older records lack a key whose default they had
            changed[section][key] = recorded[section][key]
    return changed


def announce(checked: RunConfig, folder: RunFolder, overrides: list[str]) -> None:
    """Print the work of the run and, if it takes many hours, a shorter alternative."""
    from phd_exp.hardware import has_gpu
    from phd_exp.training.train import equal_run

    data, epochs = checked.data, checked.trainer.max_epochs
    n_missing = 0
    for one in checked.rendered:
        missing = DatasetFolder(one.folder).missing(one.spec, one.n_training_split, one.n_test)
        n_missing += sum(map(len, missing.values()))
    render = f"{n_missing} images to render, then " if n_missing else ""
    network = f"{checked.backbone['_target_'].rpartition('.')[2]}{checked.backbone.get('depth', '')}"
    images = "all" if data.n_train is None else data.n_train
    gpu = has_gpu(checked.trainer.accelerator)
    print(f"{folder.path}: {render}{epochs} epochs of {network} on {images} images of", end=" ")
    print(f"{data.image_size} px, on {'a GPU' if gpu else 'the CPU'}", flush=True)
    if equal := equal_run(checked, folder):
        print(f"  {equal.path} is finished, with an equal configuration: its command uses that run again", flush=True)
    if checked.preset == "paper" and not gpu:
        shorter = shlex.join([*(word for word in overrides if not word.startswith("preset=")), "preset=small"])
        print("  the authors' protocol takes many hours without a GPU: an estimate follows the first batches")
        print(f"  in about ten minutes: python -m phd_exp {shorter}", flush=True)


def rendered(data: RenderedConfig, fewer: str = FEWER, *, cores: int, shard: Shard | None = None) -> bool:
    """Render the missing samples of a data set, or of a shard of it; returns whether all samples are there."""
    counts = data.n_training_split, data.n_test
    return ensure_rendered(DatasetFolder(data.folder), data.spec, *counts, data.workers, cores, shard, fewer)


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "not finite"


def standing(config: dict[str, Any], overrides: list[str]) -> str | None:
    """The state of a configuration's run. The configuration is not checked, because checking it imports torch."""
    try:
        folder = _folder(config, overrides)
        state, error = folder.state()
        if state in (None, "running"):
            return state
        wanted = [folder.views] if config["evaluation"]["multiview"]["scenes"] > 0 else []
        wanted += [folder.eight_views["test"]] if config["evaluation"]["eight_views"] else []
        for frames, held_out in product((size[1] for size in config["evaluation"]["sequences"]), (False, True)):
            wanted.append(folder.sequence(frames, held_out=held_out))
        wanted += map(folder.shift, config["evaluation"]["shifts"])
        if state == "finished":
            return "finished" if all(file.exists() for file in wanted) else "interrupted"
        return error or "exited without a result (killed or out of memory)"
    except UNREADABLE:  # the run itself will report it
        return None


def numbers(config: dict[str, Any], overrides: list[str]) -> str:
    """The errors and the NLL of a configuration's finished run, not checked either."""
    try:
        results = _folder(config, overrides).results()
        return ", ".join(text.format(_number(results[key])) for key, text in SUMMARY.items() if key in results)
    except UNREADABLE:
        return ""


def _folder(config: dict[str, Any], overrides: list[str]) -> RunFolder:
    data = config["data"].get("variant") or config["data"]["name"]
    preset = setting(config["preset"], config["recipe"]["name"])
    name = RunName(preset, data, config["model"]["name"], config["seed"], _hashed(overrides))
    return RunFolder(name.folder(Path(config["runs"])))


def run_name(config: RunConfig, overrides: list[str]) -> RunName:
    """The name of a run; all other overrides that can change a number go into its hash."""
    preset = setting(config.preset, config.recipe.name)
    return RunName(preset, config.data.name, config.model.name, config.seed, _hashed(overrides))


def _hashed(overrides: list[str]) -> tuple[str, ...]:
    # parsed values, because a sweep rewrites them: 1e-3 and 0.001, true and True are one value
    return tuple(
        f"{item.key_or_group}={item.get_value_element_as_str()}"
        for item in _unnamed(overrides)
        if has_influence(item.key_or_group)
    )


def _unnamed(overrides: list[str]) -> list[Override]:
    """The overrides without a place of their own in a run's name."""
    return [item for item in map(words.parsed, overrides) if item.key_or_group not in NAMED]


def _draw() -> Callable[[dict[str, Any], Path], None] | None:
    if find_spec("matplotlib") is None:
        print("calibration curves are recorded, but not drawn: that needs `pip install 'phd_exp[report]'`")
        return None
    from phd_exp.reports.figures import draw_calibration

    return draw_calibration
