"""Parts that the measuring commands share: options, progress, and the report as text, JSON and Markdown file."""

import dataclasses
import signal
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_origin, get_type_hints

import click
from click.core import ParameterSource

from wrt.cli.common import (
    ACCEL,
    DURATION,
    SHARED,
    Decorator,
    Names,
    OneOf,
    Parsed,
    json_text,
    names_of,
    option_group,
    progress_writer,
    quiet_option,
    say,
    say_json,
    warnings_reported,
)
from wrt.core.errors import InputError
from wrt.core.files import check_writable, write_bytes
from wrt.core.interrupts import exit_code
from wrt.lab import STRUCTURES, Plan
from wrt.renderer.progress import TimeLeft

# The type of an option, by the annotation of the plan's field.
TYPES: dict[object, Any] = {int: int, int | None: int, bool: bool, str: str, float: DURATION}


@dataclass(frozen=True)
class Reporting:
    """Options of a report, and the functions that write it."""

    output: Path | None = None  # file or folder to write, as the command defines
    quiet: bool = False
    as_json: bool = False

    def progress(self, line: str) -> None:
        if not self.quiet:
            say(line)

    @property
    def progress_writer(self) -> Callable[[str], None]:
        return progress_writer(self.quiet)

    def check_markdown(self) -> None:
        """Raise InputError unless `output` is None or a Markdown file that can be written."""
        self.check_report({})

    def check_report(self, others: Collection[str]) -> str:
        """Return the suffix of `output`, "" for None. Raise InputError unless it is .md or one of `others`, and can be written."""
        if self.output is None:
            return ""
        suffix = self.output.suffix.lower()
        if suffix not in (".md", *others):
            raise InputError(f"must be a {' or '.join(('.md', *others))} file, the report", path=self.output)
        check_writable(self.output)
        return suffix

    def write_rows(self, data: Mapping[str, object], text: str, files: Mapping[str, Callable[[], bytes]]) -> None:
        """Write the report `output`, if any, in the format of its suffix: one of `files`, `data` as JSON, or `text` as Markdown."""
        if self.output is None:
            return
        suffix = self.output.suffix.lower()
        if suffix == ".json":
            self.write(json_text(data))
        elif suffix in files:
            write_bytes(self.output, files[suffix]())
        else:
            self.write(text)

    def write(self, text: str) -> None:
        if self.output is not None:
            write_bytes(self.output, (text.rstrip("\n") + "\n").encode())

    def end(self, text: str, data: Mapping[str, object], paths: Sequence[Path] = (), interrupted: int | None = None) -> None:
        """Print `data` as JSON if `as_json` is set. Otherwise, print `text` and the written files: `paths`, or `output` if that is empty.

        interrupted: number of the signal that ended the work; it sets the exit code. None: the work was not interrupted."""
        if self.as_json:
            say_json(data)
        else:
            for line in (text, *(paths or filter(None, [self.output]))):
                say(line, err=False)
        if interrupted is not None:
            say("interrupted: the results so far are kept")
            raise SystemExit(exit_code(interrupted))


def reporting(report: str = "Write the tables as Markdown (.md)", *, quiet: str = "Print no progress and no warnings") -> Decorator:
    """Return a decorator that adds the options of Reporting. The command receives the object as `how`. report, quiet: help of -o and -q."""
    file = click.option("-o", "--output", type=click.Path(path_type=Path), help=report)
    return option_group("how", Reporting, names_of(Reporting), [SHARED["as_json"], quiet_option(quiet), file])


def planned(plan: type[Plan]) -> Decorator:
    """Return a decorator that adds the options of a Plan (wrt.lab). The command receives the object as `plan`.

    --quick sets the options that the command line leaves out to the values in plan.QUICK, and lists them on stderr."""

    def make(quick: bool, **values: Parsed) -> Plan:
        if quick:
            context = click.get_current_context()
            smaller = {name: value for name, value in plan.QUICK.items()
                       if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE}
            replaced = [f"{name.replace('_', '-')} {value} instead of {values[name]}" for name, value in smaller.items()]
            say(f"{context.info_name} --quick: {', '.join(replaced) or 'no effect, since the command line sets every option'}")
            values |= smaller
        return plan(**values)

    types = get_type_hints(plan)
    flag = click.option("--quick", is_flag=True, help="Get rough figures soon: use smaller defaults, and list them on stderr")
    parameters = [parameter(each, types[each.name]) for each in dataclasses.fields(plan)]
    return option_group("plan", make, ["quick", *names_of(plan)], [*parameters[::-1], flag])


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
    kind = Names() if several else ACCEL if names == STRUCTURES else TYPES[of_type]
    return click.option(flag, each.name, type=kind, default=each.default, show_default="[default" not in text, help=text)


def measured(plan: type[Plan]) -> click.Command:
    """Return the command that runs a plan's study."""

    @click.command(plan.COMMAND.split()[-1], help=plan.__doc__)
    @planned(plan)
    @reporting(plan.OUTPUT)
    def command(how: Reporting, plan: Plan) -> None:
        from wrt.lab.bench import plot, report

        study = report.study_of(plan)
        writers = report.WRITERS | getattr(study, "WRITERS", {})
        suffix = how.check_report((".json", *writers))
        if suffix in (".png", ".svg"):
            plot.new_figure(1.0, 1.0)  # raises InputError if matplotlib is missing
        total = sum(1 for _ in study.groups(plan))  # reads all meshes, and so refuses a damaged one at once
        machine = study.machine(plan) if hasattr(study, "machine") else report.machine_line()
        rows: list[Any] = []
        interrupted, left = None, TimeLeft(total)

        def done(group: list[Any]) -> None:
            rows.extend(group)
            left.done += 1
            for row in group:
                how.progress(f"{report.line(plan, row)}{f'  ({left.done:.0f} of {total}{left})' if left.done < total else ''}")

        with warnings_reported(how.quiet):
            try:
                report.run(plan, done)
            except KeyboardInterrupt as stop:
                if not rows:
                    raise
                interrupted = int(getattr(stop, "number", signal.SIGINT))
                machine = f"{machine}; interrupted after {len(rows)} row{'s' if len(rows) > 1 else ''}"
        text, data = report.text(rows, plan, machine), {"machine": machine, **report.data(rows, plan)}
        how.write_rows(data, text, {name: partial(writer, rows, plan, machine, name) for name, writer in writers.items()})
        how.end(text, {**data, "output": how.output}, interrupted=interrupted)

    return command
