"""Which runs an ensemble has, whether they fit together, and their predictions of held-out samples."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from phd_exp.models.heads import DistributionHead
from phd_exp.records.choices import first_difference, has_influence
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder

if TYPE_CHECKING:
    from phd_exp.evaluation.parquet import Columns
    from phd_exp.inference.predictor import Predictor

OF_THE_INPUT = ("data.", "camera.", "model.head.")  # keys in which the members of an ensemble agree
SIZES = ("data.n_train", "data.n_held_out", "data.n_test", "data.batch_size")  # of the data, in which they may differ


def members_of(runs: Sequence[str | Path]) -> tuple[list[RunFolder], Callable[[str], bool]]:
    """The runs to load, and which keys of theirs must be equal. A folder of seeds stands for its finished runs."""
    folders = [RunFolder(Path(run)) for run in runs]
    if len(folders) == 1 and not folders[0].config_file.exists():
        seeds = [RunFolder(path) for path in sorted(folders[0].path.glob("seed*"))]
        if finished := [seed for seed in seeds if seed.is_finished()]:
            return finished, lambda key: has_influence(key) and key != "seed"
    return folders, lambda key: has_influence(key) and key.startswith(OF_THE_INPUT) and key not in SIZES


def require_alike(
    folders: Sequence[RunFolder], predictors: Sequence["Predictor"], matters: Callable[[str], bool]
) -> None:
    """Raise ConfigError unless the runs are members of one ensemble."""
    first, (folder, *_) = predictors[0], folders
    for other, predictor in zip(folders, predictors, strict=True):
        before, now = (one.config.model_dump(mode="json") for one in (first, predictor))
        difference = first_difference(before, now, matters)
        if difference is None and (first.depth, first.constant_f) != (predictor.depth, predictor.constant_f):
            difference = f"constants.json with {first.depth}, but {predictor.depth}"
        if difference:
            raise ConfigError(
                f"run: {folder.path} has {difference} in {other.path}; expected runs on one kind of data with one "
                "camera and image size, and a folder of seeds with one configuration"
            )
    if not isinstance(first.regressor.head, DistributionHead):
        raise ConfigError(
            f"{folder.path}: predicts no uncertainty, so that it joins no ensemble; expected model=probabilistic"
        )


def held_out_table(folders: Sequence[RunFolder], views: int) -> "Columns":
    """The predictions of held-out samples, by one network or an ensemble. Raises RunError if there is no record."""
    if len(folders) > 1 and views > 1:
        raise RunError(f"views={views}: held-out predictions of several views are recorded for single runs alone")
    files = [folder.held_out if views == 1 else folder.eight_views["held_out"] for folder in folders]
    for file in files:
        if not file.exists():
            wanted = "data.n_held_out > 0" + (" and evaluation.eight_views=true" if views > 1 else "")
            raise RunError(f"{file}: missing; held-out samples are needed: train with {wanted}")
    from phd_exp.evaluation.parquet import read_table  # imports pyarrow
    from phd_exp.evaluation.predictions import ensemble_table

    tables = [read_table(file) for file in files]
    return tables[0] if len(tables) == 1 else ensemble_table(tables)
