"""Whatever numbers stand in a table of predictions: the report has its pages, and says what it left out."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from phd_exp.records.runs import RunFolder
from phd_exp.reports.collect import collect
from phd_exp.reports.site.build import build_site
from phd_exp.reports.site.dossier import read_dossier
from tests.bad_input.test_fuzz import LONG
from tests.reports.site.synthetic import write_run

TABLES = ("predictions.parquet", "held_out.parquet")
N = 40
Spoil = Callable[[str, str, Sequence[int], float], None]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Recalibrated, of 40 samples."""
    folder = tmp_path_factory.mktemp("tables")
    run = write_run(folder / "runs", "occl", n=N)
    write_run(folder / "elsewhere", "occl", seed=1, n=N).predictions.rename(run.held_out)
    return run


@pytest.fixture(scope="module")
def spoil(run: RunFolder) -> Spoil:
    whole = {name: pq.read_table(run.path / name) for name in TABLES}

    def spoil(name: str, column: str, rows: Sequence[int], value: float) -> None:
        for other, table in whole.items():
            pq.write_table(table, run.path / other)
        values = np.array(whole[name][column].to_numpy(), dtype=np.float64)
        values[list(rows)] = value
        place = whole[name].column_names.index(column)
        pq.write_table(whole[name].set_column(place, column, pa.array(values)), run.path / name)

    return spoil


@pytest.mark.parametrize(
    ("name", "column", "rows", "value", "note"),
    [
        ("predictions.parquet", "a", range(N), np.nan, "none of 40 samples has finite"),
        ("predictions.parquet", "nll", [7], np.inf, "1 test samples are left out"),
        ("predictions.parquet", "depth_squared_error", [7], -1.0, "1 of 40 are not"),
        ("predictions.parquet", "projected_squared_error", [7], 1e-300, "column projected_squared_error is 1e-300"),
        ("held_out.parquet", "mu_z", [7], -1.0, "parameters are of no distribution"),
        ("held_out.parquet", "A_xx", [7], 1e300, "column A_xx is 1e\\+300 in row 7; expected 0, or a size from"),
    ],
)  # fmt: skip
def test_the_page_of_a_run_says_so(
    run: RunFolder, spoil: Spoil, name: str, column: str, rows: Sequence[int], value: float, note: str
) -> None:
    spoil(name, column, rows, value)
    (found,) = collect(run.path.parents[3]).runs
    (said,) = read_dossier(found).notes
    assert re.search(note, said), said
    assert "\n" not in said


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_site_is_built(run: RunFolder, spoil: Spoil, tmp_path: Path) -> None:
    columns = [name for name in pq.read_schema(run.predictions).names if name != "file_name"]

    @settings(LONG, max_examples=150)
    @given(
        st.sampled_from(TABLES), st.sampled_from(columns), st.lists(st.integers(0, N - 1), min_size=1, unique=True),
        st.floats() | st.sampled_from([0.0, -1.0, 1e99, -1e99, 1e-99, np.nan, np.inf]),
    )  # fmt: skip
    def built(name: str, column: str, rows: list[int], value: float) -> None:
        spoil(name, column, rows, value)
        assert build_site(run.path.parents[3], tmp_path).exists()

    built()
