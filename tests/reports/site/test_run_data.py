"""What pages share of a run: safe to put into a page, and the same when it is read back."""

import json
from pathlib import Path

import numpy as np
import pytest

from phd_exp.evaluation.predictions import Band
from phd_exp.reports.site.charts import POINTS, Chart, decades, line, thinned
from phd_exp.reports.site.run_data import RunData, as_script, read_script, run_script


@pytest.mark.parametrize(
    "text", ["</script><script>", "<!--", "a & b", "line\u2028separator\u2029", '"quote\\', "é"]
)
def test_a_script_holds_any_text(text: str) -> None:
    script = as_script(text, {text: [text]})
    assert not set("<>&\u2028\u2029") & set(script)
    arguments = script.removeprefix("phdExp.receive(").removesuffix(");\n")
    name, content = json.loads(f"[{arguments}]")
    assert (name, content) == (text, {text: [text]})


def test_a_run_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    chart = Chart("title", "label", [line("test", [0, 1, 2], [1.0, None, float("nan")], 1)], {"xaxis": {}})
    run = RunData(
        key="0", slug="a", preset="p", data="d", model="m", run="seed0", title="m on d", state="finished", n=3,
        scores={"nll": Band(1.0, 0.5, 1.5)}, recalibrated={}, config={"seed": "0"}, charts={"learning_nll": chart},
    )  # fmt: skip
    file = tmp_path / "a.js"
    file.write_text(run_script(run))
    assert read_script(file) == run
    file.write_text(run_script(run)[:-40])
    assert read_script(file) is None
    assert read_script(tmp_path / "none.js") is None


@pytest.mark.parametrize("n", [0, 1, 2, POINTS, POINTS + 1, 5 * POINTS + 3])
def test_a_thinned_curve_keeps_its_ends(n: int) -> None:
    kept = thinned(n)
    assert len(kept) == min(n, POINTS)
    assert kept == sorted(set(kept))
    assert kept[:1] == list(range(n))[:1]
    assert kept[-1:] == list(range(n))[-1:]


def test_decades_hold_all_that_is_positive() -> None:
    for values in ([3e-4, 0.2], [1.0], [0.1, 0.1], [0.0, -1.0, None], []):
        low, high = decades(values)
        assert np.log10(high / low) >= 1 - 1e-9
        assert all(low <= v <= high for v in values if v is not None and v > 0)
