"""Tables of predictions, which somebody else may have written: read whole, or refused in one line."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from phd_exp.records.errors import RunError, gist
from phd_exp.records.files import MB, require_plain

LARGEST = 1000 * MB
"""Bytes of the file, and of the table that it says it unfolds to."""
MOST_ROWS = 10**6
MOST_COLUMNS = 200
TEXTS = ("file_name",)
EXTREMES = (1e-100, 1e100)
"""What is finite and not zero lies between: farther out squares and ratios leave what a float holds."""


def read_table(file: Path, names: Sequence[str] | None = None) -> pa.Table:
    """These columns of a table (all by default): numbers, and the names of files.

    Raises RunError, one line, where the file is missing, cannot be read, holds more than a run leaves, lacks a
    column, or has one of another kind.
    """
    try:
        require_plain(file, LARGEST)
        metadata = pq.read_metadata(file)
        schema = metadata.schema.to_arrow_schema()
        _require_columns(file, schema, names)
        _require_small(file, metadata)
        # one long text, said to stand in every row, is kept once
        texts = [name for name in TEXTS if name in schema.names]
        with pq.ParquetFile(file, metadata=metadata, read_dictionary=texts) as parquet:
            table = parquet.read(columns=None if names is None else list(names))
        _require_moderate(file, table)
        return table
    except FileNotFoundError:
        raise RunError(f"{file.name}: missing, though the run says finished") from None
    except (pa.ArrowException, OSError, KeyError) as error:
        raise RunError(f"{file.name}: cannot be read ({gist(error)})") from None


def _require_small(file: Path, metadata: pq.FileMetaData) -> None:
    groups = [metadata.row_group(index) for index in range(metadata.num_row_groups)]
    size = sum(group.total_byte_size for group in groups)
    if metadata.num_rows > MOST_ROWS or size > LARGEST:
        raise RunError(
            f"{file.name}: says it holds {metadata.num_rows} rows of {size / MB:.0f} MB together; expected at most "
            f"{MOST_ROWS} rows of {LARGEST / MB:.0f} MB"
        )


def _require_moderate(file: Path, table: pa.Table) -> None:
    least, most = EXTREMES
    for name in table.column_names:
        if name in TEXTS:
            continue
        sizes = np.abs(np.asarray(table[name].to_numpy(), dtype=np.float64))
        extreme = np.isfinite(sizes) & (sizes != 0) & ((sizes < least) | (sizes > most))
        if extreme.any():
            row = int(extreme.argmax())
            raise RunError(
                f"{file.name}: column {name} is {table[name][row]} in row {row}; expected 0, or a size from "
                f"{least:g} to {most:g}"
            )


def _require_columns(file: Path, schema: pa.Schema, names: Sequence[str] | None) -> None:
    if lacking := [name for name in names or () if name not in schema.names]:
        raise RunError(f"{file.name}: has no column {', '.join(lacking)}")
    if len(schema.names) > MOST_COLUMNS or len(set(schema.names)) < len(schema.names):
        raise RunError(
            f"{file.name}: has {len(schema.names)} columns, some twice; expected at most {MOST_COLUMNS}"
        )
    for field in schema:
        if field.name in TEXTS:
            expected, fits = "text", _is_text(field.type)
        else:
            expected, fits = "numbers", _is_number(field.type)
        if not fits and (names is None or field.name in names):
            raise RunError(f"{file.name}: column {field.name!r} holds {field.type}; expected {expected}")


def _is_text(kind: pa.DataType) -> bool:
    values = kind.value_type if pa.types.is_dictionary(kind) else kind
    return bool(pa.types.is_string(values) or pa.types.is_large_string(values))


def _is_number(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind))
