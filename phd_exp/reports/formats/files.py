"""Tables on disk, each written whole."""

from collections.abc import Sequence
from pathlib import Path

from phd_exp.records.errors import UserError
from phd_exp.records.files import write_atomic
from phd_exp.reports.formats.latex import latex
from phd_exp.reports.formats.markdown import markdown
from phd_exp.reports.formats.tidy import tidy
from phd_exp.reports.tables import PaperTable


def write_tables(tables: Sequence[PaperTable], out: Path) -> Path:
    """Write <out>/tables/{table1,table2}-<preset>-{whole,central}.{md,tex} and tables.csv; returns that folder.

    Raises UserError where the folder cannot be written.
    """
    folder = out / "tables"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for table in tables:
            name = f"{table.name}-{table.preset}-{table.reading}"
            write_atomic(folder / f"{name}.md", markdown(table))
            write_atomic(folder / f"{name}.tex", latex(table))
        write_atomic(folder / "tables.csv", tidy(tables))
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder by out=DIR"
        ) from None
    return folder
