"""The table of the seven constraints."""

from markdown_it import MarkdownIt

from phd_exp.distributions.constraints import Finding
from phd_exp.reports.constraints import constraints_table


def test_the_table_says_what_was_measured() -> None:
    measured = {
        "3 p = 0 behind": {"mae_vz": Finding(False, 36.04), "mae_logz": Finding(True, 0.0)},
        "5 -log p convex": {"mae_vz": Finding(False, 1.72), "mae_logz": Finding(False, 1.8e9)},
    }
    text = constraints_table(measured)
    html = MarkdownIt("gfm-like", {"linkify": False}).render(text)
    assert html.count("<tr>") == 3
    for shown in ("mae_vz", "<strong>breaks</strong> (36)", "holds (0)", "(1.8e+09)", "5 -log p convex"):
        assert shown in html
