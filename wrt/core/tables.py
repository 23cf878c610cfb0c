"""Tables of equally long columns as files, CSV and Parquet with pyarrow, and tables in HTML for notebooks.

All text in HTML is escaped, because names come from files."""

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from wrt.core.checks import as_path
from wrt.core.errors import InputError
from wrt.core.files import replacing
from wrt.core.packages import needed_by
from wrt.core.types import PathLike

T = TypeVar("T")
Columns = Mapping[str, np.ndarray]
ROWS_AT_ONCE = 65536  # bounds the memory for the text of numbers
SHOWN_ROWS = 200  # of a table in HTML; more rows make a notebook slow


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


def html_table(title: str, head: Sequence[object], rows: Iterable[Sequence[object]], most: int | None = SHOWN_ROWS) -> str:
    """Return an HTML table of the first `most` rows, and a line with the number of further rows. title: "" for no title."""
    rows = list(rows)
    out = [f"<b>{html.escape(title)}</b>"] if title else []
    out += ["<table>", *([_row(head, "th")] if head else []), *(_row(row, "td") for row in rows[:most]), "</table>"]
    if most is not None and len(rows) > most:
        out.append(f"<p>and {len(rows) - most} more</p>")
    return "".join(out)


class Rows(list[T]):
    """A list of a report's rows. A notebook shows it as the HTML that `page` returns for the rows."""

    def __init__(self, rows: Iterable[T], page: Callable[[Sequence[T]], str]) -> None:
        super().__init__(rows)
        self._page = page

    def _repr_html_(self) -> str:
        return self._page(self)


def number(value: object) -> str:
    """Format an integer with thousands separators and a float with four digits; anything else as text."""
    if isinstance(value, bool) or not hasattr(value, "__round__"):
        return str(value)
    return f"{value:,}" if hasattr(value, "__index__") else f"{value:.4g}"


def _row(cells: Sequence[object], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(number(cell))}</{tag}>" for cell in cells) + "</tr>"
