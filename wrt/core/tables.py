"""Tables of equally long columns as files: CSV, and Parquet with pyarrow."""

from collections.abc import Callable, Mapping

import numpy as np

from wrt.core.checks import as_path
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.core.write_file import replacing

Columns = Mapping[str, np.ndarray]
ROWS_AT_ONCE = 65536  # bounds the memory for the text of numbers


def write_table(path: PathLike, columns: Columns) -> None:
    """Write columns, (N,) each, by the suffix of the path. Raises InputError for another suffix, without pyarrow, or if writing fails."""
    path = as_path(path, "path")
    suffix = path.suffix.lower()
    if suffix not in TABLES:
        raise InputError(f"must have the suffix {' or '.join(TABLES)}, got {suffix or 'none'}", path=path)
    TABLES[suffix](path, columns)


def _csv(path: PathLike, columns: Columns) -> None:
    """Write numbers in the shortest form that reads back to the same bits; inf and nan as such."""
    with replacing(path) as file:
        file.write(",".join(columns).encode() + b"\n")
        for first in range(0, len(next(iter(columns.values()))), ROWS_AT_ONCE):
            texts = [column[first:first + ROWS_AT_ONCE].astype(str) for column in columns.values()]
            file.writelines(",".join(row).encode() + b"\n" for row in zip(*texts, strict=True))


def _parquet(path: PathLike, columns: Columns) -> None:
    with needed_by("a Parquet file"):
        import pyarrow
        from pyarrow import parquet
    with replacing(path) as file:
        parquet.write_table(pyarrow.table(dict(columns)), file)


TABLES: dict[str, Callable[[PathLike, Columns], None]] = {".csv": _csv, ".parquet": _parquet}
