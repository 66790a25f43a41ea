"""`python -m phd_exp render`: a data set, or what is missing of it, or one share of that; or whether it is sound."""

from typing import Any

from phd_exp.cli.app import launch
from phd_exp.records.dataset import DatasetFolder
from phd_exp.rendering.masks import require_elsewhere, write_masks
from phd_exp.rendering.render import ensure_rendered, render_shard
from phd_exp.rendering.verify import verify
from phd_exp.training.config import RenderConfig, RenderedConfig, check_render


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
    if not _render(checked, folder, cores):
        return  # other shards are missing
    print(f"{folder.root}: {data.n_training_split} training and {data.n_test} test samples are there")
    if checked.masks is not None:
        print(f"{checked.masks}: {write_masks(folder, checked.masks)} masks")


def _render(checked: RenderConfig, folder: DatasetFolder, cores: int) -> bool:
    """Render all of a data set, or one share of it; whether all of it is there."""
    data = checked.data
    if checked.shard is None:
        ensure_dataset(data, cores)
        return True
    return render_shard(
        folder, data.spec, data.n_training_split, data.n_test, checked.shard, data.workers, cores
    )


def ensure_dataset(data: RenderedConfig, cores: int) -> None:
    """Render what a run needs and the folder lacks."""
    ensure_rendered(
        DatasetFolder(data.folder), data.spec, data.n_training_split, data.n_test, data.workers, cores
    )
