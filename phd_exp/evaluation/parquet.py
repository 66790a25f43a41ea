"""Tables of predictions, which anyone may have written: columns of numbers, or one line that says why not."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from phd_exp.records.errors import RunError, gist
from phd_exp.records.files import MB, require_plain

Columns = Mapping[str, np.ndarray]
"""Column name -> one value a sample: float64, or text for `TEXTS`."""

LARGEST = 500 * MB
"""Bytes of the file, and of the table that it claims to hold."""
MOST_VALUES = 10**7
"""Rows times columns. Predictions of 2,000 images have 80,000."""
TEXTS = ("file_name",)


def read_table(file: Path, names: Sequence[str] = ()) -> Columns:
    """All columns of a table that has at least one row and these `names`.

    The size is bounded before any row is read: a file of 100 kB can unfold to gigabytes.

    Raises RunError, one line, where the file is missing, cannot be read, is too large, lacks a column, or holds
    something else than numbers.
    """
    try:
        require_plain(file, LARGEST)
        with open(file, "rb") as stream:  # pyarrow opens no name that is not UTF-8
            metadata = pq.read_metadata(stream)
            _require_small(file, metadata)
            # a text that repeats in every row is stored once
            texts = [name for name in TEXTS if name in metadata.schema.to_arrow_schema().names]
            columns = arrays(pq.ParquetFile(stream, metadata=metadata, read_dictionary=texts).read())
    except FileNotFoundError:
        raise RunError(f"{file.name}: missing, though the run has finished") from None
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{file.name}: cannot be read ({gist(error)})") from None
    if lacking := [name for name in names if name not in columns]:
        raise RunError(f"{file.name}: has no column {', '.join(lacking)}")
    return columns


def arrays(table: pa.Table | Columns) -> dict[str, np.ndarray]:
    """The columns of a table as arrays. Raises ValueError or TypeError for a column that holds no numbers."""
    if isinstance(table, pa.Table):
        table = {name: table[name].to_numpy() for name in table.column_names}
    return {name: column if name in TEXTS else _numbers(name, column) for name, column in table.items()}


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype == object and any(not isinstance(value, int | float | None) for value in column):
        raise TypeError(f"column {name!r} holds {type(column[0]).__name__}; expected numbers")
    return np.array(column, dtype=np.float64)


def _require_small(file: Path, metadata: pq.FileMetaData) -> None:
    size = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
    values = metadata.num_rows * metadata.num_columns
    if metadata.num_rows == 0:
        raise RunError(f"{file.name}: has no rows")
    if values > MOST_VALUES or size > LARGEST:
        raise RunError(
            f"{file.name}: has {metadata.num_rows} rows of {metadata.num_columns} columns; expected at most "
            f"{MOST_VALUES} values and {LARGEST / MB:.0f} MB"
        )
