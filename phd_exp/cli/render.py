"""`python -m phd_exp render`: a data set, or what is missing of it, or one share of that."""

from typing import Any

from phd_exp.cli.app import launch
from phd_exp.records.dataset import DatasetFolder
from phd_exp.rendering.shards import render_shard
from phd_exp.rendering.workers import ensure_rendered
from phd_exp.training.config import DataConfig, check_render


def main(arguments: list[str]) -> int:
    return launch(task, arguments, config_name="render")


def task(config: dict[str, Any], overrides: list[str]) -> None:
    checked = check_render(config)
    data = checked.data
    if checked.shard is None:
        ensure_dataset(data)
    elif not render_shard(
        DatasetFolder(data.folder), data.spec, data.n_train, data.n_test, checked.shard, data.workers
    ):
        return
    print(f"{data.folder}: {data.n_train} training and {data.n_test} test samples are there")


def ensure_dataset(data: DataConfig) -> None:
    """Render what a run needs and the folder lacks."""
    ensure_rendered(DatasetFolder(data.folder), data.spec, data.n_train, data.n_test, data.workers)
