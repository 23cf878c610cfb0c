"""What the commands that measure share: options, progress, where a report goes, and text or JSON at the end."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
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
    Names,
    OneOf,
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

TYPES: dict[str, Any] = {"int": int, "int | None": int, "bool": bool, "str": str, "Sequence[str]": Names(), "float": DURATION}


@dataclass(frozen=True)
class Reporting:
    """output: a report's file or folder (None: none); cluster: a Dask scheduler's address; quiet: no progress; as_json: JSON, not
    text."""

    output: Path | None = None
    cluster: str | None = None
    quiet: bool = False
    as_json: bool = False

    def progress(self, line: str) -> None:
        if not self.quiet:
            say(line)

    @property
    def now_and_then(self) -> Callable[[str], None]:
        return now_and_then(self.quiet)

    def check_markdown(self) -> None:
        """Raise InputError where a Markdown file cannot be written there, before any work is done for it."""
        if self.output is None:
            return
        if self.output.suffix.lower() != ".md":
            raise InputError("the report is a .md file", path=self.output)
        check_writable(self.output)

    def write(self, text: str) -> None:
        if self.output is not None:
            write_bytes(self.output, (text.rstrip("\n") + "\n").encode())

    def end(self, text: str, data: dict[str, Any], paths: Sequence[Path] = (), interrupted: int | None = None) -> None:
        """The result on stdout, and what was written: `paths`, or the output. interrupted: the signal that ended the work early,
        whose exit code this ends with."""
        if self.as_json:
            say_json(data)
        else:
            for line in (text, *(paths or filter(None, [self.output]))):
                say(line, err=False)
        if interrupted is not None:
            say("interrupted: what was done is kept")
            raise SystemExit(exit_code(interrupted))


def reporting(report: str = "Write the tables as Markdown (.md)", *, cluster: bool = False,
              quiet: str = "No progress, no warnings") -> Callable[[Any], Any]:
    """A command with these options, which it gets as one argument, `how`. report: help of -o."""
    options = [SHARED["as_json"],
               click.option("-q", "--quiet", is_flag=True, help=quiet),
               click.option("-o", "--output", type=click.Path(path_type=Path), help=report)]
    return gathering("how", Reporting, names_of(Reporting), [*options, CLUSTER] if cluster else options)


def planned(plan: type[Plan]) -> Callable[[Any], Any]:
    """A command with a plan's options, which it gets as one argument, `plan`. With --quick the plan's QUICK stands in for the
    options that are not given, and one line says for which."""

    def make(quick: bool, **given: Any) -> Plan:
        if quick:
            context = click.get_current_context()
            less = {name: value for name, value in plan.QUICK.items()
                    if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE}
            told = [f"{name.replace('_', '-')} {value} instead of {given[name]}" for name, value in less.items()]
            say(f"{context.info_name} --quick: {', '.join(told) or 'all is given, nothing is left out'}")
            given |= less
        return plan(**given)

    flag = click.option("--quick", is_flag=True, help="Rough figures soon: less of all that is not given here, as it says")
    return gathering("plan", make, ["quick", *names_of(plan)], [*map(parameter, dataclasses.fields(plan)[::-1]), flag])


def parameter(each: dataclasses.Field[Any]) -> Any:
    """A field of a plan as an argument or an option of a command."""
    known, needed = each.metadata, each.default is MISSING
    kind = TYPES.get(str(each.type), click.Path(path_type=Path))
    if not known["text"]:
        several: Any = {"nargs": -1, "required": needed} if str(each.type).startswith("Sequence") else {}
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
    """Return the command that runs the study of a plan, each mesh on one worker where there is a cluster. The study is a module as
    wrt.lab.bench.report.study_of says."""

    @click.command(plan.COMMAND.split()[-1], help=plan.__doc__)
    @planned(plan)
    @reporting(cluster="meshes" in plan.__annotations__)
    def command(how: Reporting, plan: Any) -> None:
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
