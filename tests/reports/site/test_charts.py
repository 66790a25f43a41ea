"""Chart data is safe in a page."""

import json

import numpy as np
import pytest

from phd_exp.reports.figures import decades
from phd_exp.reports.site.pages import as_script


@pytest.mark.parametrize("text", ["</script><script>", "<!--", "a & b", "line\u2028separator\u2029", '"quote\\', "é"])
def test_a_script_holds_any_text(text: str) -> None:
    script = as_script(text, {text: [text]})
    assert not set("<>&\u2028\u2029") & set(script)
    arguments = script.removeprefix("phdExp.receive(").removesuffix(");\n")
    name, content = json.loads(f"[{arguments}]")
    assert (name, content) == (text, {text: [text]})


def test_decades_contain_all_positive_values() -> None:
    for values in ([3e-4, 0.2], [1.0], [0.1, 0.1], [0.0, -1.0, float("nan"), 2.0]):
        low, high = decades(values) or (0, 0)
        assert np.log10(high / low) >= 1 - 1e-9
        assert all(low <= value <= high for value in values if value > 0)
    assert decades([0.0, -1.0, float("nan"), float("inf")]) is None
