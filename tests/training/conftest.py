"""Runs of a second, without a renderer and the command line: images of noise, a network of 8 channels."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phd_exp.config import check
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.runs import RunFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.training.train import train
from tests.support.handmade import write_handmade
from tests.support.recorded import once

TINY = (
    "preset=smoke", "recipe=strong", "backbone.width=8", "backbone.channels=4", "data.variant=handmade",
    "data.sensor_size=64", "data.f_range=[400,600]", "data.image_size=32", "data.n_train=16", "data.n_held_out=4",
    "data.n_test=6", "data.batch_size=8", "logger=none", "trainer=cpu", "trainer.threads=1",
    "trainer.progress_bar=false",
)  # fmt: skip


@pytest.fixture(scope="session")
def handmade(make_spec: Callable[..., DatasetSpec], tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    spec = make_spec("handmade", sensor_size=64, f_range=(400.0, 600.0))
    place = once(
        tmp_path_factory,
        "handmade renders",
        lambda root: write_handmade(DatasetFolder(root / "handmade"), spec, {"train": 20, "test": 6}),
    )
    return DatasetFolder(place / "handmade")


@pytest.fixture(scope="session")
def run_in(composed: Callable[..., dict[str, Any]], handmade: DatasetFolder) -> Callable[..., RunFolder]:
    """Train in a folder, with overrides of the smallest configuration."""

    def run(path: Path, *overrides: str, draw: Any = None) -> RunFolder:
        config = check(composed(*TINY, f"data.root={handmade.root.parent}", *overrides))
        train(config, RunFolder(path), draw, cores=1)
        return RunFolder(path)

    return run
