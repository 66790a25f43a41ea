"""From trained runs, folders or files, to a `Predictor`: of one network, or of an ensemble whose members fit."""

from collections.abc import Callable, Sequence
from pathlib import Path

from phd_exp.build import recorded_constants, trained_network
from phd_exp.config import RunConfig, check
from phd_exp.config.targets import Trust
from phd_exp.inference.predictor import Predictor
from phd_exp.records.choices import first_difference, has_influence
from phd_exp.records.errors import ConfigError, RunError, listed
from phd_exp.records.packed import opened, or_example
from phd_exp.records.runs import RunFolder

OF_THE_INPUT = ("data.", "camera.", "model.head.")  # keys in which the members of an ensemble agree
SIZES = ("data.n_train", "data.n_held_out", "data.n_test", "data.batch_size")  # of the data, in which they may differ


def load(
    run: str | Path | Sequence[str | Path],
    device: str = "auto",
    recalibrate: bool = False,
    trust: Trust = (),
    views: int = 1,
    margin: float = 1.0,
) -> Predictor:
    """The network of a run's best checkpoint, or its last; or an ensemble of several runs or views.

    Args:
        run: the run's folder, a file of `pack`, or `cylinder`, which comes with the package; several,
            or a folder of seeds, for an ensemble.
        device: "auto" chooses a GPU if there is one.
        recalibrate: apply temperatures fitted to the run's predictions of all held-out samples.
        trust: packages other than phd_exp whose classes the run may build; None: any.
        views: 8 for an ensemble of the eight symmetric views of each image.
        margin: side of the view of each box over that of the box.

    Raises:
        RunError: the folder holds no usable run.
        ConfigError: its configuration is invalid, names code that is not trusted, or cannot be recalibrated; or the
            runs do not fit together.
    """
    folders, matters = _members([run] if isinstance(run, str | Path) else run)
    configs = [_config(folder, trust) for folder in folders]
    _require_alike(folders, configs, matters)
    network = trained_network(folders, configs, views, device)
    states = ["unknown" if (status := folder.status()) is None else status.state for folder in folders]
    state = next((state for state in states if state != "finished"), "finished")
    predictor = Predictor(configs[0], network, recorded_constants(folders[0])[0], state, tuple(folders), margin)
    return predictor.recalibrated() if recalibrate else predictor


def _members(runs: Sequence[str | Path]) -> tuple[list[RunFolder], Callable[[str], bool]]:
    """The runs to load, and which keys of theirs must be equal. A folder of seeds stands for its finished runs."""
    folders = [opened(or_example(Path(run))) for run in runs]
    if len(folders) == 1 and not folders[0].config_file.exists():
        seeds = [RunFolder(path) for path in sorted(folders[0].path.glob("seed*"))]
        if finished := [seed for seed in seeds if seed.is_finished()]:
            return finished, lambda key: has_influence(key) and key != "seed"
    return folders, lambda key: has_influence(key) and key.startswith(OF_THE_INPUT) and key not in SIZES


def _config(folder: RunFolder, trust: Trust) -> RunConfig:
    if not folder.config_file.exists():
        below = [file.parent for depth in range(4) for file in folder.path.glob("*/" * depth + "seed*/config.yaml")]
        one = f"one of the runs below it: {listed(sorted(map(str, below)))}"
        run = "a folder with config.yaml and checkpoints/last.ckpt, or a file of `pack`"
        raise RunError(f"{folder.path}: no run; expected {one if below else run}")
    return check(folder.config(), trust)


def _require_alike(
    folders: Sequence[RunFolder], configs: Sequence[RunConfig], matters: Callable[[str], bool]
) -> None:
    """Raise ConfigError unless the runs are members of one ensemble."""
    before = configs[0].model_dump(mode="json")
    for folder, config in zip(folders[1:], configs[1:], strict=True):
        difference = first_difference(before, config.model_dump(mode="json"), matters)
        (depth, f), (other, other_f) = map(recorded_constants, (folders[0], folder))
        if difference is None and (depth != other or (config.camera.focal_length == "constant" and f != other_f)):
            difference = f"constants.json with {depth}, but {other}"
        if difference:
            raise ConfigError(
                f"run: {folders[0].path} has {difference} in {folder.path}; expected runs on one kind of data with "
                "one camera and image size, and a folder of seeds with one configuration"
            )
