"""What all measurements tell with: the machine, tables as Markdown and as HTML, a report's files."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import wrt
from wrt.core.checks import as_integer, require_known
from wrt.core.device import describe_devices
from wrt.core.errors import InputError
from wrt.core.html import html_table
from wrt.core.write_file import replacing
from wrt.lab.bench.plot import LogLogPlot, new_figure
from wrt.picture.image import check_writable, write_codes

T = TypeVar("T")


# --- before -----------------------------------------------------------------------------------------------------------


def check_plan(plan: Any, names: Mapping[str, tuple[Iterable[str], Any]], **ranges: tuple[int, int]) -> None:
    """Raise InputError where one of a plan's numbers is out of its range, or there is nothing of a name. names: what they are,
    the names, and the table that has them; ranges: field -> least and most."""
    for name, (low, high) in ranges.items():
        as_integer(getattr(plan, name), name, low, high)
    for what, (chosen, known) in names.items():
        for name in chosen:
            require_known(name, known, what)


def machine(used: str = "", *more: str, device: str = "cpu") -> str:
    """The device, the threads that are used, how busy it is, and wrt's version: without them no time means anything."""
    line = next((line for line in describe_devices() if line.startswith(f"{device}:")), device)
    load = "" if math.isnan(load_average()) else f"load average {load_average():.1f} at the start"
    return "; ".join([", ".join(filter(None, [line, used, load])), f"wrt {wrt.__version__}", *more])


def load_average() -> float:
    """NaN where the system has none."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan


def gathered(rows: Iterable[T], report: Callable[[T], None] | None) -> list[T]:
    """All rows; `report` gets each as it is done."""
    out = []
    for row in rows:
        out.append(row)
        if report is not None:
            report(row)
    return out


# --- after ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A piece of a report: a heading, paragraphs, a table (head, lines), a plot by its file's name."""

    title: str = ""
    text: str = ""
    head: Sequence[str] = ()
    lines: Sequence[Sequence[str]] = ()
    plot: str = ""


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns are also straight as plain text; numbers to the right."""
    texts = [[str(cell).replace("|", "\\|") for cell in line] for line in (head, *lines)]
    width = [max(len(line[i]) for line in texts) for i in range(len(head))]

    def text(line: Sequence[str]) -> str:
        padded = [cell.ljust(width[i]) if i == 0 else cell.rjust(width[i]) for i, cell in enumerate(line)]
        return f"| {' | '.join(padded)} |"

    rule = [":" + "-" * (width[0] - 1), *("-" * (w - 1) + ":" for w in width[1:])]
    return "\n".join([text(texts[0]), text(rule), *map(text, texts[1:])])


def markdown(parts: Iterable[Part]) -> str:
    pieces = []
    for part in parts:
        pieces += [f"## {part.title}" if part.title else "", part.text, table(part.head, part.lines) if part.lines else "",
                   f"![{part.title or part.plot}]({part.plot})" if part.plot else ""]
    return "\n\n".join(filter(None, pieces)) + "\n"


def page(parts: Iterable[Part]) -> str:
    """The tables as HTML, for a notebook."""
    return "".join(html_table(part.title, part.head, part.lines) for part in parts if part.lines)


def check_folder(folder: Path, names: Iterable[str], *, parents: bool = False) -> None:
    """Make the folder if it is not there; InputError where files of these names, plots among them, cannot be written to it."""
    try:
        folder.mkdir(parents=parents, exist_ok=True)
    except OSError as error:
        raise InputError(f"no folder to write to: {error.strerror}", folder) from error
    for name in names:
        check_writable(folder / name)
    new_figure(1.0, 1.0)  # there is matplotlib


def write(path: Path, text: str, plots: Mapping[str, LogLogPlot]) -> list[Path]:
    """The text, and beside it plots by their file names; the paths. Raises InputError where the system refuses."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    beside = [path.with_name(name) for name in plots]
    for target, plot in zip(beside, plots.values(), strict=True):
        write_codes(target, plot.draw())
    return [path, *beside]
