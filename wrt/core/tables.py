"""Tables in HTML for notebooks. All text is escaped, because names come from files."""

import html
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

T = TypeVar("T")
SHOWN_ROWS = 200  # of a table in HTML; more rows make a notebook slow


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
