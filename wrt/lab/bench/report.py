"""What all measurements share: description of the machine, rows, and tables as Markdown and HTML."""

import csv
import importlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

import wrt
from wrt.core.device import describe_devices
from wrt.core.tables import Rows, html_table
from wrt.core.types import JsonObject
from wrt.lab import Plan


def machine_line(used: str = "", *more: str, device: str = "cpu") -> str:
    """Describe the conditions of a measurement in one line: device, `used` (text about threads), load, wrt's version and `more` texts."""
    line = next((line for line in describe_devices() if line.startswith(f"{device}:")), device)
    load = f"load average {os.getloadavg()[0]:.1f} at the start" if hasattr(os, "getloadavg") else ""
    return "; ".join([", ".join(filter(None, [line, used, load])), f"wrt {wrt.__version__}", *more])


def versions(*packages: str) -> str:
    """Return names and versions of those packages that are installed."""
    from importlib.metadata import PackageNotFoundError, version

    found = []
    for package in packages:
        with suppress(PackageNotFoundError):
            found.append(f"{package} {version(package)}")
    return ", ".join(found)


class Row(SimpleNamespace):
    """Results of one measurement, as attributes; LEGEND in the study's module explains their names.
    JSON contains all attributes except NumPy arrays and names that begin with _."""

    def as_dict(self) -> JsonObject:
        return {name: plain(value) for name, value in vars(self).items() if not (name.startswith("_") or isinstance(value, np.ndarray))}


def plain(value: object) -> object:
    """Convert a value for JSON: rows and dataclasses in the value become dictionaries."""
    if isinstance(value, list):
        return [plain(each) for each in value]
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    return value.as_dict() if hasattr(value, "as_dict") else vars(value) if is_dataclass(value) else value


# Heading of a column -> its cell for a row: a format string over the row's attributes, or a function of the row.
Columns = Mapping[str, str | Callable[[Any], str]]


def cells(columns: Columns, row: object) -> list[str]:
    """Return the cells of one row of a table."""
    return [column.format_map(vars(row)) if isinstance(column, str) else column(row) for column in columns.values()]


def grouped(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Group rows by the values of these attributes, in the order of first appearance."""
    out: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        out.setdefault(tuple(getattr(row, name) for name in names), []).append(row)
    return out


def study_of(plan: Plan) -> ModuleType:
    """Return the module that measures a plan.

    The module has TITLE, LEGEND, and groups(plan). It yields functions; each measures a group of Rows that are compared with each other.
    COLUMNS or parts(rows, plan) make the tables.
    Optional are machine(plan) for the report, line(row) for a line of progress, and facts(rows, plan) for more JSON fields."""
    return importlib.import_module(plan.STUDY)


Groups = Iterator[Callable[[], list[Row]]]


def run(plan: Plan, report: Callable[[list[Row]], None] = lambda rows: None) -> Rows[Row]:
    """Measure everything and return the rows; `report` receives the rows of each group once it is measured."""
    rows = []
    for measure in study_of(plan).groups(plan):
        rows += (group := measure())
        report(group)
    return Rows[Row](rows, partial(page, plan))


def parts_of(rows: Sequence[Row], plan: Plan) -> "list[Part]":
    """Return the tables and texts of a study: its parts(), or one table with its COLUMNS."""
    study = study_of(plan)
    return study.parts(rows, plan) if hasattr(study, "parts") else [tabled(study.COLUMNS, rows)]


def page(plan: Plan, rows: Sequence[Row]) -> str:
    """Return the tables of a study as HTML, for a notebook."""
    return tables_page(parts_of(rows, plan))


def mesh_name(mesh: object) -> str:
    """Return the name of a mesh, or the name of a mesh file without its folder."""
    return Path(getattr(mesh, "name", mesh) or "mesh").name  # type: ignore[arg-type]


def line(plan: Plan, row: Row) -> str:
    """Format a row as a line of progress."""
    study = study_of(plan)
    if hasattr(study, "line"):
        return study.line(row)
    return "  ".join([*([row.mesh] if "mesh" in vars(row) and "mesh" not in study.COLUMNS else []), *cells(study.COLUMNS, row)])


def data(rows: Sequence[Row], plan: Plan) -> JsonObject:
    """Return the rows and further fields of a study for JSON."""
    facts: Any = getattr(study_of(plan), "facts", lambda rows, plan: {})
    return {"rows": [row.as_dict() for row in rows], **facts(rows, plan)}


def csv_text(rows: Sequence[Row], plan: Plan, machine: str) -> str:
    """Return the rows as CSV, with lines that begin with # for the command and the machine. Columns are the fields in JSON.

    A field of a dictionary has the column "name.field". A list is a JSON text in one cell. A field that a row lacks is empty."""
    lines = [flat(row.as_dict()) for row in rows]
    columns = list(dict.fromkeys(name for line in lines for name in line))
    text = io.StringIO(f"# command: {repeating(plan)}\n# machine: {machine}\n")
    text.seek(0, io.SEEK_END)
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def flat(fields: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Return the fields of a JSON object as cells of one line of CSV."""
    out: dict[str, object] = {}
    for name, value in fields.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{prefix}{name}.")
        else:
            out[prefix + name] = json.dumps(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
    return out


def text(rows: Sequence[Row], plan: Plan, machine: str) -> str:
    """Return the report as Markdown."""
    study = study_of(plan)
    head = f"# {study.TITLE}\n\nMachine: {machine}\n\nTo repeat: `{repeating(plan)}`\n\n"
    return f"{head}{markdown(parts_of(rows, plan))}\n{study.LEGEND}"


def short(thing: object) -> str:
    """Return the name of a mesh, a file without its folder, "name=file" without the file's folder, or another text."""
    name, sign, path = thing.partition("=") if isinstance(thing, str) else ("", "", "")
    return f"{name}={mesh_name(path)}" if sign else mesh_name(thing)


def repeating(plan: Plan) -> str:
    """Return the command line that repeats the measurement; names of files have no folders."""
    words = [f"python -m wrt {plan.COMMAND}"]
    for each in fields(plan):
        value, flag = getattr(plan, each.name), f"--{each.name.replace('_', '-')}"
        several = isinstance(value, Sequence) and not isinstance(value, str)
        if not each.metadata["text"]:
            words += map(short, value if several else (value,))
        elif isinstance(value, bool):
            words += [flag] if value else []
        elif value not in (None, ()) and (value != each.default or isinstance(value, int)):
            words.append(f"{flag} {','.join(map(short, value)) if several else value}")
    return " ".join(words)


@dataclass(frozen=True)
class Part:
    """A section of a report. title: heading; text: paragraphs; head: headings of the table's columns; lines: cells of each table row."""

    title: str = ""
    text: str = ""
    head: Sequence[str] = ()
    lines: Sequence[Sequence[str]] = ()


def tables_page(parts: Iterable[Part]) -> str:
    return "".join(html_table(part.title, part.head, part.lines) for part in parts if part.lines)


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table that is also aligned as plain text: the first column to the left, other columns to the right."""
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
        pieces += [f"## {part.title}" if part.title else "", part.text, table(part.head, part.lines) if part.lines else ""]
    return "\n\n".join(filter(None, pieces)) + "\n"


def tabled(columns: Columns, rows: Iterable[object], title: str = "", text: str = "") -> Part:
    """Return a Part whose table has a line for each row."""
    return Part(title, text, tuple(columns), [cells(columns, row) for row in rows])
