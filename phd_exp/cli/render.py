"""`python -m phd_exp render`: a data set, or what is missing of it, or one share of that; or whether it is sound."""

from typing import Any

from phd_exp.cli.app import launch
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import Shard
from phd_exp.rendering.finished import require_elsewhere, verify, write_masks
from phd_exp.rendering.render import ensure_rendered
from phd_exp.training.config import RenderedConfig, check_render


def main(arguments: list[str]) -> int:
    """Render as the words of the command line ask, once or for every combination; returns the exit status."""
    return launch(task, arguments, config_name="render")


def task(config: dict[str, Any], overrides: list[str], cores: int) -> None:
    """What one job of rendering does."""
    checked = check_render(config)
    data, folder = checked.data, DatasetFolder(checked.data.folder)
    if checked.masks is not None:
        require_elsewhere(folder, checked.masks)
    if checked.verify:
        n = verify(folder, data.spec, checked.rerender)
        print(f"{folder.root}: all {n} samples are as they were rendered")
        return
    if not ensure_dataset(data, cores, checked.shard):
        return  # other shards are missing
    print(f"{folder.root}: {data.n_training_split} training and {data.n_test} test samples are there")
    if checked.masks is not None:
        print(f"{checked.masks}: {write_masks(folder, checked.masks)} masks")


def ensure_dataset(data: RenderedConfig, cores: int, shard: Shard | None = None) -> bool:
    """Render what the folder lacks of a data set, or of one shard of it; returns whether all of it is there."""
    folder, n_train = DatasetFolder(data.folder), data.n_training_split
    return ensure_rendered(folder, data.spec, n_train, data.n_test, data.workers, cores, shard)
