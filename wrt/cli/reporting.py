"""What the commands that measure share: options, progress, where a report goes, and text or JSON at the end."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from wrt.cli.common import CLUSTER, client_of, now_and_then, say, say_json, warnings_reported
from wrt.core.errors import InputError
from wrt.core.interrupts import exit_code

MESHES = click.argument("meshes", nargs=-1, type=click.Path(path_type=Path))


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
        if self.output is not None and (self.output.suffix.lower() != ".md" or not self.output.parent.is_dir()):
            raise InputError("the report is a .md file in a folder that is there", self.output)

    def write(self, text: str) -> None:
        if self.output is not None:
            self.output.write_text(text.rstrip("\n") + "\n", encoding="utf-8")

    def end(self, text: str, data: dict[str, Any], paths: Sequence[Path] = (), interrupted: int | None = None) -> None:
        """The result on stdout. interrupted: the signal that ended the work early, whose exit code this ends with."""
        if self.as_json:
            say_json(data)
        else:
            for line in (text, *paths):
                click.echo(line)
        if interrupted is not None:
            say("interrupted: what was done is kept")
            raise SystemExit(exit_code(interrupted))


def reporting(report: str | None, *, cluster: bool = False, quiet: str = "No progress, no warnings") -> Callable[[Any], Any]:
    """A command with these options, which it gets as one argument, `how`. report: help of -o (None: no such option)."""
    options = [click.option("--json", "as_json", is_flag=True, help="Print as JSON"),
               click.option("-q", "--quiet", is_flag=True, help=quiet)]
    options += [click.option("-o", "--output", type=click.Path(path_type=Path), help=report)] if report else []
    options += [CLUSTER] if cluster else []

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def reported(**given: Any) -> None:
            how = {name: given.pop(name) for name in ("output", "cluster", "quiet", "as_json") if name in given}
            command(how=Reporting(**how), **given)

        return functools.reduce(lambda wrapped, option: option(wrapped), options, reported)

    return decorate


def measure(how: Reporting, study: Any, options: dict[str, Any]) -> None:
    """Run a study of wrt.lab.bench, each mesh on one worker where there is a cluster. study: the module, with Plan, run, machine,
    line, text and data; one with PLOTS writes a folder (write_report), else its text is a Markdown file."""
    from wrt.lab.bench.report import check_folder
    from wrt.lab.bench.sweep import by_mesh

    plan, plots = study.Plan(**options), getattr(study, "PLOTS", None)
    if plots is None:
        how.check_markdown()
    elif how.output is not None:
        check_folder(how.output, plots)
    client = client_of(how.cluster)
    machine = study.machine(plan)
    if client is not None:
        from wrt.renderer.distributed.dask import machines

        machine = f"a cluster, each mesh on one worker: {machines(client)}; started from {machine}"
    with warnings_reported(how.quiet):
        rows = by_mesh(study.run, plan, lambda row: how.progress(study.line(row)), client)
    text, data, paths = study.text(rows, machine), {"machine": machine, **study.data(rows)}, []
    if plots is None:
        how.write(text)
    elif how.output is not None:
        paths = study.write_report(rows, plan, how.output, machine)
    if "output" in click.get_current_context().params:
        data["output"] = how.output if plots is None else paths
    how.end(text, data, paths)
