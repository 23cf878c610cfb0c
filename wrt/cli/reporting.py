"""The command of a measurement: options from the fields of its Plan, progress, and the report as text, Markdown, JSON or CSV."""

import dataclasses
import signal
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import MISSING
from itertools import chain
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import click
from click.core import ParameterSource

from wrt.cli.common import ACCEL, DURATION, Decorator, Names, OneOf, Parsed, json_text, naming, say, say_json, shared, warnings_reported
from wrt.core.errors import InputError
from wrt.core.files import check_writable, write_bytes
from wrt.core.interrupts import exit_code
from wrt.lab import STRUCTURES, OnScene, Plan
from wrt.renderer.progress import TimeLeft

# The type of an option, by the annotation of the plan's field.
TYPES: dict[object, Any] = {int: int, int | None: int, bool: bool, str: str, str | None: str, float: DURATION}
OUTPUT = click.option("-o", "--output", type=click.Path(path_type=Path),
                      help="Write the tables as Markdown (.md), or the rows as .csv or .json")
QUICK = click.option("--quick", is_flag=True, help="Get rough figures soon: use smaller defaults, and list them on stderr")


def parameter(each: dataclasses.Field[object], of_type: object) -> Decorator:
    """Return a decorator that adds a plan's field `each` to a command, as an argument or an option."""
    text, names, needed = each.metadata["text"], each.metadata["of"], each.default is MISSING
    several = get_origin(of_type) is Sequence
    kind: Any
    if not text:
        kind = OneOf(names[1]) if names else str if of_type == Sequence[str] else click.Path(path_type=Path)
        return click.argument(each.name, type=kind, metavar=each.name.upper() if names else None, nargs=-1 if several else 1,
                              required=needed)
    flag = f"--{each.name.replace('_', '-')}"
    if of_type is bool:
        return click.option(flag, each.name, is_flag=True, help=text)
    if several:  # names,names or several times
        return click.option(flag, each.name, type=Names(), multiple=True, default=each.default, show_default=bool(each.default), help=text,
                            callback=lambda context, option, values: tuple(chain(*values)))
    kind = ACCEL if names == STRUCTURES else TYPES[of_type]
    return click.option(flag, each.name, type=kind, default=each.default, show_default="[default" not in text, help=text)


def smaller(plan: type[Plan], values: dict[str, Parsed]) -> dict[str, Any]:
    """Return the values of plan.QUICK for the options that the command line leaves out, and list them on stderr."""
    context = click.get_current_context()
    found = {name: value for name, value in plan.QUICK.items() if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE}
    replaced = [f"{name.replace('_', '-')} {value} instead of {values[name]}" for name, value in found.items()]
    say(f"{context.info_name} --quick: {', '.join(replaced) or 'no effect, since the command line sets every option'}")
    return found


def measured(kind: type[Plan]) -> click.Command:
    """Return the command that runs the study of a kind of plan. Ctrl-C keeps the finished rows."""

    def measure(quick: bool, output: Path | None, quiet: bool, as_json: bool, **values: Parsed) -> None:
        from wrt.lab.bench import report

        plan = kind(**values | (smaller(kind, values) if quick else {}))
        suffix = "" if output is None else output.suffix.lower()
        if output is not None:
            if suffix not in (".md", ".json", ".csv"):
                raise InputError("must be a .md, .json or .csv file, the report", path=output)
            check_writable(output)
        study = report.study_of(plan)
        rows: list[Any] = []
        interrupted, machine = None, ""

        def done(group: list[Any]) -> None:
            rows.extend(group)
            left.done += 1
            more = f"{left.done:.0f} of {left.total}{left}" if left.done < left.total else ""
            for text in () if quiet else [report.line(plan, row) for row in group] or [""]:
                say("  ".join(filter(None, (text, f"({more})" if more else ""))))

        with warnings_reported(quiet), naming(Path(plan.scene)) if isinstance(plan, OnScene) else nullcontext():
            left = TimeLeft(sum(1 for _ in study.groups(plan)))  # reads all files, and so refuses a damaged one at once
            machine = study.machine(plan) if hasattr(study, "machine") else report.machine_line()
            try:
                report.run(plan, done)
            except KeyboardInterrupt as stop:
                if not rows:
                    raise
                interrupted = int(getattr(stop, "number", signal.SIGINT))
                machine = f"{machine}; interrupted after {len(rows)} row{'s' if len(rows) > 1 else ''}"
        text, data = report.text(rows, plan, machine), {"machine": machine, **report.data(rows, plan)}
        if output is not None:
            content = json_text(data) if suffix == ".json" else report.csv_text(rows, plan, machine) if suffix == ".csv" else text
            write_bytes(output, f"{content.rstrip()}\n".encode())
        if as_json:
            say_json({**data, "output": output})
        else:
            for line in filter(None, (text, output)):
                say(line, err=False)
        if interrupted is not None:
            say("interrupted: the results so far are kept")
            raise SystemExit(exit_code(interrupted))

    types = get_type_hints(kind)
    parameters = [parameter(each, types[each.name]) for each in dataclasses.fields(kind)]
    command: Any = measure
    decorators: list[Decorator] = [shared("quiet", "as_json"), OUTPUT, *parameters[::-1], QUICK]
    for decorate in decorators:
        command = decorate(command)
    return click.command(kind.COMMAND.split()[-1], help=kind.__doc__)(command)
