"""Reads tables of predictions: columns of numbers, or a RunError of one line. The files are not trusted."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from phd_exp.records.errors import RunError, reading
from phd_exp.records.files import MB, require_plain

Arrays = Mapping[str, np.ndarray]
"""Column name -> one value per sample: float64, or text for `TEXTS`; `distributions.columns.Columns` are tensors."""

LARGEST = 500 * MB  # bytes of the file, and of the table according to its metadata
MOST_VALUES = 10**7  # rows times columns; predictions of 2,000 images have 80,000
TEXTS = ("file_name",)


def read_table(file: Path) -> Arrays:
    """All columns of a table that has at least one row.

    The size is checked before any row is read: a file of 100 kB can expand to gigabytes.

    Raises RunError, one line, if the file is missing, cannot be read, is too large, or contains other values than
    numbers.

    Examples:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile(suffix=".parquet") as file:
        ...     pq.write_table(pa.table({"z": [3.5, 4.5]}), file.name)
        ...     read_table(Path(file.name))["z"].tolist()
        [3.5, 4.5]
    """
    if not file.exists():
        raise RunError(f"{file}: missing, though the run has finished")
    with reading(file, kind=RunError):
        require_plain(file, LARGEST)
        # pyarrow opens no name that is not UTF-8, and its threads may hold buffers of a Python file while the program
        # exits, which would abort it
        with open(file, "rb") as named, pa.OSFile(f"/dev/fd/{named.fileno()}") as stream:
            metadata = pq.read_metadata(stream)
            _require_small(file, metadata)
            # a text that repeats in every row is kept once in memory
            texts = [name for name in TEXTS if name in metadata.schema.to_arrow_schema().names]
            table = pq.ParquetFile(stream, metadata=metadata, read_dictionary=texts).read()
            return {name: _values(name, table[name]) for name in table.column_names}


def require_columns(names: Iterable[str], table: Collection[str], what: str = "predictions") -> None:
    """Raise RunError if a table lacks one of these columns."""
    if lacking := [name for name in names if name not in table]:
        raise RunError(f"{what}: no column {', '.join(lacking)}, as in older records; run the model again")


def stacked(columns: Mapping[str, Any], names: Sequence[str]) -> Tensor:
    """Columns side by side, arrays or tensors, along a new last dimension."""
    return torch.from_numpy(np.stack([columns[name] for name in names], axis=-1))


def _values(name: str, stored: pa.ChunkedArray) -> np.ndarray:
    """The texts or numbers of a column, without pandas, which `to_numpy` imports. Raises TypeError for others."""
    if name in TEXTS and pa.types.is_dictionary(stored.type):
        column = stored.combine_chunks()
        rows = column.indices.fill_null(len(column.dictionary)) if column.null_count else column.indices
        texts = np.array([*column.dictionary.to_pylist(), None], dtype=object)
        return np.asarray(texts[np.from_dlpack(rows)])
    kinds = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean, pa.types.is_null)
    if not any(is_kind(stored.type) for is_kind in kinds):
        raise TypeError(f"column {name!r} holds {stored.type}; expected numbers")
    numbers = stored.cast(pa.float64(), safe=False)
    numbers = numbers.fill_null(math.nan) if numbers.null_count else numbers
    return np.array(np.from_dlpack(numbers.combine_chunks()))


def _require_small(file: Path, metadata: pq.FileMetaData) -> None:
    size = sum(metadata.row_group(index).total_byte_size for index in range(metadata.num_row_groups))
    values = metadata.num_rows * metadata.num_columns
    if metadata.num_rows == 0:
        raise RunError(f"{file}: has no rows")
    if values > MOST_VALUES or size > LARGEST:
        raise RunError(
            f"{file}: has {metadata.num_rows} rows of {metadata.num_columns} columns; expected at most "
            f"{MOST_VALUES} values and {LARGEST / MB:.0f} MB"
        )
