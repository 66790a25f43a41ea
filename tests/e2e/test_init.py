"""A training that starts from the weights of a finished run."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.records.runs import RunFolder
from tests.e2e.conftest import QUICK, QUICKER
from tests.e2e.runs import only_run


def test_it_begins_where_that_run_ended_with_its_constants_of_depth(
    phd_exp: Callable, run: RunFolder, renders: Path, tmp_path: Path
) -> None:
    """On scenes at other distances, whose own constants are others."""
    words = (*QUICK, *QUICKER, f"data.root={tmp_path / 'far'}", "data.variant=far", "data.z_range=[4,7]")
    assert phd_exp(*words, f"init={run.path}").status == 0
    mine = only_run(tmp_path / "runs")
    assert mine.constants() == run.constants()
    same = (*QUICK, *QUICKER, f"data.root={renders}", f"init={run.path}", f"runs={tmp_path / 'same'}")
    assert phd_exp(*same).status == 0
    before, after = run.results(), only_run(tmp_path / "same").results()
    assert after["untrained/test/nll"] == pytest.approx(before["test/nll"], rel=1e-5)
    assert after["test/nll"] != before["test/nll"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("init=nowhere",), r"init: got nowhere; expected the folder of a finished run"),
        (("init={run}", "backbone.width=16"), r"init: .* \(.*size mismatch.*this backbone and head"),
        (("init={run}", "model=mae_vz"), r"init: .*; expected a run with this backbone"),
    ],
    ids=str,
)
def test_a_run_that_does_not_fit_is_one_line(
    phd_exp: Callable, run: RunFolder, renders: Path, words: tuple[str, ...], message: str
) -> None:
    given = (word.format(run=run.path) for word in words)
    outcome = phd_exp(*QUICK, *QUICKER, f"data.root={renders}", *given)
    assert outcome.status in (1, 2)
    assert len(outcome.err.splitlines()) == 1
    assert re.search(message, outcome.err)
