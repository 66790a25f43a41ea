"""From trained runs, folders or files, to a `Predictor`: of one network, or of an ensemble whose members fit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from phd_exp.build import build_regressor, recorded_constants, require_same_shrinking
from phd_exp.config import RunConfig, check
from phd_exp.config.targets import OTHER_VERSION, Trust, custom_parts, is_ours
from phd_exp.geometry.charts import DepthScale
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import SymmetricHead
from phd_exp.models.regressor import Regressor
from phd_exp.models.weights import fill, regressor_weights
from phd_exp.records.choices import first_difference, has_influence
from phd_exp.records.errors import ConfigError, RunError, UserError, gist, listed
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
    first, *others = predictors = [_load(folder, device, trust) for folder in folders]
    if others or views > 1:
        _require_alike(predictors, matters)
        state = next((one.state for one in predictors if one.state != "finished"), "finished")
        networks = tuple(other.regressor for other in others)
        first = replace(first, folders=tuple(folders), others=networks, views=views, state=state)
    first = replace(first, margin=margin)
    return first.recalibrated() if recalibrate else first


def _members(runs: Sequence[str | Path]) -> tuple[list[RunFolder], Callable[[str], bool]]:
    """The runs to load, and which keys of theirs must be equal. A folder of seeds stands for its finished runs."""
    folders = [opened(or_example(Path(run))) for run in runs]
    if len(folders) == 1 and not folders[0].config_file.exists():
        seeds = [RunFolder(path) for path in sorted(folders[0].path.glob("seed*"))]
        if finished := [seed for seed in seeds if seed.is_finished()]:
            return finished, lambda key: has_influence(key) and key != "seed"
    return folders, lambda key: has_influence(key) and key.startswith(OF_THE_INPUT) and key not in SIZES


def _require_alike(predictors: Sequence[Predictor], matters: Callable[[str], bool]) -> None:
    """Raise ConfigError unless the runs are members of one ensemble."""
    first, place = predictors[0], predictors[0].folders[0].path
    before = first.config.model_dump(mode="json")
    for other in predictors:
        difference = first_difference(before, other.config.model_dump(mode="json"), matters)
        if difference is None and (first.depth, first.constant_f) != (other.depth, other.constant_f):
            difference = f"constants.json with {first.depth}, but {other.depth}"
        if difference:
            raise ConfigError(
                f"run: {place} has {difference} in {other.folders[0].path}; expected runs on one kind of data with "
                "one camera and image size, and a folder of seeds with one configuration"
            )
    if not isinstance(first.regressor.head, SymmetricHead):
        raise ConfigError(
            f"{place}: predicts no uncertainty, so that it joins no ensemble; expected model=probabilistic"
        )


def _load(folder: RunFolder, device: str, trust: Trust) -> Predictor:
    """The network of one run, as trained."""
    if not folder.config_file.exists():
        below = [file.parent for depth in range(4) for file in folder.path.glob("*/" * depth + "seed*/config.yaml")]
        one = f"one of the runs below it: {listed(sorted(map(str, below)))}"
        run = "a folder with config.yaml and checkpoints/last.ckpt, or a file of `pack`"
        raise RunError(f"{folder.path}: no run; expected {one if below else run}")
    config = check(folder.config(), trust)
    require_same_shrinking(folder, config.data)
    depth, constant_f = recorded_constants(folder)
    place = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device)
    regressor = _regressor(folder, config, depth)
    status = folder.status()
    return Predictor(
        config=config,
        regressor=regressor.requires_grad_(False).eval().to(place),
        side=config.data.image_size,
        depth=depth,
        constant_f=constant_f if config.camera.focal_length == "constant" else None,
        device=place,
        temperature=None,
        state="unknown" if status is None else status.state,
        folders=(folder,),
    )


def _regressor(folder: RunFolder, config: RunConfig, depth: DepthScale) -> Regressor:
    """The network with the weights of a checkpoint, of which only tensors are read.

    It is first built without memory, and must fit: a stored configuration may describe a network of any size.
    """
    weights = regressor_weights(folder.best_checkpoint)
    # the user's own networks may need their numbers
    if not custom_parts({"head": config.model.head, "backbone": config.backbone}):
        with torch.device("meta"), _Uninitialised():
            fill(_built(folder, config, depth), weights, folder.best_checkpoint, assign=True)
    regressor = _built(folder, config, depth)
    fill(regressor, weights, folder.best_checkpoint)
    return regressor


class _Uninitialised(TorchFunctionMode):
    """Leaves out normal random numbers, for which torch imports its compiler where tensors have no memory."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func is torch.Tensor.normal_ else func(*args, **(kwargs or {}))


def _built(folder: RunFolder, config: RunConfig, depth: DepthScale) -> Regressor:
    try:
        return build_regressor(config, depth, is_new=False)
    except UserError as error:
        if not is_ours([config.model.head, config.backbone]):
            raise
        raise ConfigError(f"{error}{OTHER_VERSION}") from error
    except Exception as error:  # parts that a stranger has named may raise any
        reason = f"{type(error).__name__}: {gist(error)}"
        raise ConfigError(f"{folder.config_file}: describes no network ({reason}){OTHER_VERSION}") from error
