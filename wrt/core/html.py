"""Tables as a notebook shows them. Everything in them is escaped: names come out of files."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

T = TypeVar("T")
SHOWN_ROWS = 200  # of one table; more make a notebook slow


def html_table(title: str, head: Sequence[Any], rows: Iterable[Sequence[Any]], most: int | None = SHOWN_ROWS) -> str:
    """One HTML table; beyond `most` rows it says how many are left out. title: above it, "" is none."""
    rows = list(rows)
    out = [f"<b>{html.escape(title)}</b>"] if title else []
    out.append("<table>")
    if head:
        out.append(_row(head, "th"))
    out += [_row(row, "td") for row in rows[:most]]
    out.append("</table>")
    if most is not None and len(rows) > most:
        out.append(f"<p>and {len(rows) - most} more</p>")
    return "".join(out)


class Rows(list[T]):
    """The rows of a report: a list that a notebook shows as what `page` makes of it (HTML)."""

    def __init__(self, rows: Iterable[T], page: Callable[[Sequence[T]], str]) -> None:
        super().__init__(rows)
        self._page = page

    def _repr_html_(self) -> str:
        return self._page(self)


def number(value: Any) -> str:
    """A number as a table shows it: integers with their thousands apart, floats with four digits; anything else as text."""
    if isinstance(value, bool) or not hasattr(value, "__round__"):
        return str(value)
    return f"{value:,}" if hasattr(value, "__index__") else f"{value:.4g}"


def _row(cells: Sequence[Any], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(number(cell))}</{tag}>" for cell in cells) + "</tr>"
