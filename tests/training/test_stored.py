"""Runs that were trained on images prepared differently are refused."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from phd_exp.data.images import SHRINKING
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import check
from phd_exp.training.network import require_same_shrinking


@pytest.mark.parametrize("side", [64, 112])
@pytest.mark.parametrize("version", [None, SHRINKING - 1, SHRINKING])
@pytest.mark.parametrize("begun", [True, False])
def test_another_shrinking_is_refused_where_it_matters(
    composed: Callable[..., dict[str, Any]], tmp_path: Path, side: int, version: int | None, begun: bool
) -> None:
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    if begun:
        folder.last_checkpoint.touch()
    if version is not None:
        folder.write_constants({"shrinking": version})
    config = check(composed("data.sensor_size=224", f"data.image_size={side}"))
    refused = begun and side == 64 and version != SHRINKING
    with pytest.raises(RunError, match="shrunk from 224 to 64 pixels") if refused else nullcontext():
        require_same_shrinking(folder, config)
