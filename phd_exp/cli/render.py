"""`python -m phd_exp render`: a data set, or what is missing of it."""

from typing import Any

from phd_exp.cli.app import launch
from phd_exp.records.dataset import DatasetFolder
from phd_exp.rendering.workers import ensure_rendered
from phd_exp.training.config import RenderedConfig, check_data


def main(arguments: list[str]) -> int:
    return launch(task, arguments)


def task(config: dict[str, Any], overrides: list[str]) -> None:
    data = check_data(config)
    ensure_dataset(data)
    print(f"{data.folder}: {data.n_train} training and {data.n_test} test samples are there")


def ensure_dataset(data: RenderedConfig) -> None:
    """Render what a run needs and the folder lacks."""
    ensure_rendered(DatasetFolder(data.folder), data.spec, data.n_train, data.n_test, data.workers)
