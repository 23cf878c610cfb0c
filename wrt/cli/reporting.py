"""Parts that the measuring commands share: options, progress, the report's file, and the final text or JSON."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from wrt.cli.common import (
    ACCEL,
    CLUSTER,
    DURATION,
    SHARED,
    Decorator,
    Names,
    OneOf,
    Parsed,
    client_of,
    gathering,
    names_of,
    now_and_then,
    say,
    say_json,
    warnings_reported,
)
from wrt.core.errors import InputError
from wrt.core.interrupts import exit_code
from wrt.core.write_file import check_writable, write_bytes
from wrt.lab.plans import STRUCTURES, Plan

# Types of options by the annotations of a plan's fields; all others are paths.
TYPES: dict[str, Any] = {"int": int, "int | None": int, "bool": bool, "str": str, "Sequence[str]": Names(), "float": DURATION}


@dataclass(frozen=True)
class Reporting:
    """The options of a report."""

    output: Path | None = None  # file or folder of the report
    cluster: str | None = None  # address of a Dask scheduler
    quiet: bool = False
    as_json: bool = False

    def progress(self, line: str) -> None:
        if not self.quiet:
            say(line)

    @property
    def now_and_then(self) -> Callable[[str], None]:
        return now_and_then(self.quiet)

    def check_markdown(self) -> None:
        """Raise InputError if the report, a Markdown file, cannot be written."""
        if self.output is None:
            return
        if self.output.suffix.lower() != ".md":
            raise InputError("the report is a .md file", path=self.output)
        check_writable(self.output)

    def write(self, text: str) -> None:
        if self.output is not None:
            write_bytes(self.output, (text.rstrip("\n") + "\n").encode())

    def end(self, text: str, data: Mapping[str, object], paths: Sequence[Path] = (), interrupted: int | None = None) -> None:
        """Write the result and the written files (`paths`, or the output) to stdout. interrupted: exit with this signal's code."""
        if self.as_json:
            say_json(data)
        else:
            for line in (text, *(paths or filter(None, [self.output]))):
                say(line, err=False)
        if interrupted is not None:
            say("interrupted: what was done is kept")
            raise SystemExit(exit_code(interrupted))


def reporting(report: str = "Write the tables as Markdown (.md)", *, cluster: bool = False,
              quiet: str = "No progress, no warnings") -> Decorator:
    """Give a command the options of Reporting, which it gets as the argument `how`. report, quiet: help of -o and -q."""
    options = [SHARED["as_json"],
               click.option("-q", "--quiet", is_flag=True, help=quiet),
               click.option("-o", "--output", type=click.Path(path_type=Path), help=report)]
    return gathering("how", Reporting, names_of(Reporting), [*options, CLUSTER] if cluster else options)


def planned(plan: type[Plan]) -> Decorator:
    """Give a command a plan's options, which it gets as the argument `plan`.

    --quick replaces the options that are not given by the plan's QUICK, and reports them in one line."""

    def make(quick: bool, **given: Parsed) -> Plan:
        if quick:
            context = click.get_current_context()
            less = {name: value for name, value in plan.QUICK.items()
                    if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE}
            replaced = [f"{name.replace('_', '-')} {value} instead of {given[name]}" for name, value in less.items()]
            say(f"{context.info_name} --quick: {', '.join(replaced) or 'all is given, nothing is left out'}")
            given |= less
        return plan(**given)

    flag = click.option("--quick", is_flag=True, help="Rough figures soon: less of all that is not given here, as it says")
    return gathering("plan", make, ["quick", *names_of(plan)], [*map(parameter, dataclasses.fields(plan)[::-1]), flag])


def parameter(each: dataclasses.Field[object]) -> Decorator:
    """Return a field of a plan as an argument or an option of a command."""
    known, needed = each.metadata, each.default is MISSING
    kind = TYPES.get(str(each.type), click.Path(path_type=Path))
    if not known["text"]:
        several: dict[str, Any] = {"nargs": -1, "required": needed} if str(each.type).startswith("Sequence") else {}
        kind = OneOf(known["of"][1]) if known["of"] else str if each.name == "cases" else kind
        return click.argument(each.name, type=kind, metavar=each.name.upper() if known["of"] else None, **several)
    flag = f"--{each.name.replace('_', '-')}"
    if kind is bool:
        return click.option(flag, each.name, is_flag=True, help=known["text"])
    if known["of"] == STRUCTURES and kind is str:
        kind = ACCEL
    return click.option(flag, each.name, type=kind, default=each.default, show_default="[default" not in known["text"],
                        help=known["text"])


def measured(plan: type[Plan]) -> click.Command:
    """Return the command that runs a plan's study (wrt.lab.bench.report.study_of); a cluster runs each mesh on one worker."""

    @click.command(plan.COMMAND.split()[-1], help=plan.__doc__)
    @planned(plan)
    @reporting(cluster="meshes" in plan.__annotations__)
    def command(how: Reporting, plan: Plan) -> None:
        from wrt.lab.bench import report
        from wrt.lab.bench.sweep import by_mesh

        study = report.study_of(plan)
        how.check_markdown()
        client = client_of(how.cluster)
        machine = study.machine(plan) if hasattr(study, "machine") else report.machine_line()
        if client is not None:
            from wrt.renderer.distributed.dask import machines

            machine = f"a cluster, each mesh on one worker: {machines(client)}; started from {machine}"
        with warnings_reported(how.quiet):
            rows = by_mesh(report.run, plan, lambda row: how.progress(report.line(plan, row)), client)
        text = report.text(rows, plan, machine)
        how.write(text)
        how.end(text, {"machine": machine, **report.data(rows, plan), "output": how.output})

    return command
