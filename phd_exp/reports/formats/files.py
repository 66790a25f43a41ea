"""Tables on disk, each written whole."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from phd_exp.records.errors import UserError
from phd_exp.records.files import remove_temporaries, write_atomic
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.formats.tidy import tidy
from phd_exp.reports.tables import PaperTable, Table
from phd_exp.reports.variations import VariationTable

if TYPE_CHECKING:  # torch, which tables on single views need not wait for
    from phd_exp.reports.fusion_table import FusionTable


def write_tables(tables: Sequence[PaperTable], out: Path) -> Path:
    """Write `<out>/tables/{table1,table2}-<preset>-{whole,central}.{md,tex}` and `tables.csv`; returns that folder.

    Raises UserError where the folder cannot be written.
    """
    with _folder(out) as folder:
        _write_each(tables, folder)
        write_atomic(folder / "tables.csv", tidy(tables))
    return folder


def write_fusion_tables(tables: "Sequence[FusionTable]", out: Path) -> Path:
    """Write `<out>/tables/fusion-<run>.{md,tex}` and `fusion.csv`; returns that folder.

    Raises UserError where the folder cannot be written.
    """
    from phd_exp.reports.formats.tidy_fusion import tidy_fusion

    with _folder(out) as folder:
        _write_each(tables, folder)
        write_atomic(folder / "fusion.csv", tidy_fusion(tables))
    return folder


def write_variation_tables(tables: Sequence[VariationTable], out: Path) -> Path:
    """Write `<out>/tables/variations-<preset>-<data>-<model>.{md,tex}`; returns that folder.

    Raises UserError where the folder cannot be written.
    """
    with _folder(out) as folder:
        _write_each(tables, folder)
    return folder


def _write_each(tables: Sequence[Table], folder: Path) -> None:
    for table in tables:
        write_atomic(folder / f"{table.stem}.md", markdown(table))
        write_atomic(folder / f"{table.stem}.tex", latex(table))


@contextmanager
def _folder(out: Path) -> Iterator[Path]:
    folder = out / "tables"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_temporaries(folder)  # of a process that was killed
        yield folder
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder by out=DIR"
        ) from None
