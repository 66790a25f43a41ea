"""What the tests of inference share."""

from collections.abc import Callable
from typing import Any

import pytest

from phd_exp.records.runs import RunFolder
from tests.support.untrained import SMALL, untrained


@pytest.fixture(scope="module")
def make(composed: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., RunFolder]:
    """An untrained run of some overrides."""
    return lambda *words: untrained(tmp_path_factory.mktemp("runs") / "run", composed(*SMALL, *words))
