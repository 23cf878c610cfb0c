"""Tables as a notebook shows them. Everything in them is escaped: names come out of files."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

SHOWN_ROWS = 200  # of one table; more make a notebook slow


def html_table(title: str, head: Sequence[Any], rows: Iterable[Sequence[Any]]) -> str:
    """One HTML table; beyond SHOWN_ROWS rows it says how many are left out. title: above it, "" is none."""
    rows = list(rows)
    out = [f"<b>{html.escape(title)}</b>"] if title else []
    out.append("<table>")
    if head:
        out.append(_row(head, "th"))
    out += [_row(row, "td") for row in rows[:SHOWN_ROWS]]
    out.append("</table>")
    if len(rows) > SHOWN_ROWS:
        out.append(f"<p>and {len(rows) - SHOWN_ROWS} more</p>")
    return "".join(out)


def html_facts(title: str, facts: Mapping[str, Any]) -> str:
    """A table of names and values."""
    return html_table(title, (), facts.items())


def number(value: Any) -> str:
    """A number as a table shows it: integers with their thousands apart, floats with four digits; anything else as text."""
    if isinstance(value, bool) or not hasattr(value, "__round__"):
        return str(value)
    return f"{value:,}" if hasattr(value, "__index__") else f"{value:.4g}"


def _row(cells: Sequence[Any], tag: str) -> str:
    # Jupyter draws text cells on the right; names are read from the left.
    style = ' style="text-align:left"'
    return "<tr>" + "".join(
        f"<{tag}{style if isinstance(cell, str) else ''}>{html.escape(number(cell))}</{tag}>" for cell in cells) + "</tr>"
