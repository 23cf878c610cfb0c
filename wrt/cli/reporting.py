"""Parts that the measuring commands share: options, progress, and the report as text, JSON and Markdown file."""

import dataclasses
import signal
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin, get_type_hints

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
from wrt.core.interrupts import exit_code
from wrt.core.write_file import check_writable, write_bytes
from wrt.lab.plans import STRUCTURES, Plan
from wrt.renderer.progress import TimeLeft

if TYPE_CHECKING:
    from wrt.lab.bench.resume import Finished

T = TypeVar("T")
RESUME = click.option("--resume", is_flag=True, help="Continue an interrupted run: keep the finished rows in the file of -o (.json or"
                                                     " .csv), if its options and the version of wrt are the same")
# The type of an option, by the annotation of the plan's field. Any other annotation means a path.
TYPES: dict[object, Any] = {int: int, int | None: int, bool: bool, str: str, Sequence[str]: Names(), float: DURATION}


@dataclass(frozen=True)
class Reporting:
    """Options of a report, and the functions that write it."""

    output: Path | None = None  # file or folder to write, as the command defines
    cluster: str | None = None  # address of a Dask scheduler
    quiet: bool = False
    as_json: bool = False
    resume: bool = False

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

    def finished(self, plan: Plan, classes: Sequence[type] = ()) -> "Finished":
        """Return the groups that the report `output` of an interrupted run has, or none without --resume. classes: see resume.load."""
        from wrt.lab.bench import resume

        if not self.resume:
            return resume.Finished()
        if self.cluster is not None:
            raise InputError("works on one machine, not with --cluster", argument="--resume")
        if self.output is None or self.output.suffix.lower() not in resume.SUFFIXES:
            raise InputError(f"needs the report to resume: -o with a {' or '.join(resume.SUFFIXES)} file", argument="--resume")
        return resume.load(self.output, plan, classes)

    def rows_of(self, measure: Callable[[Callable[[T], None]], list[T]], line: Callable[[T], str],
                finished: "Finished", total: int) -> tuple[list[T], int | None]:
        """Measure, and show each finished row with the time left. Return all rows, and the number of the signal that ended the work.

        measure: function that takes a callback for finished rows. finished: groups of an earlier run; `measure` appends its own. total:
        number of groups, 0 if unknown. After Ctrl-C the finished rows are returned; without any, KeyboardInterrupt is raised."""
        before, kept = len(finished.groups), finished.rows
        left = TimeLeft(total - before)

        def done(row: T) -> None:
            kept.append(row)
            left.done = len(finished.groups) - before
            self.progress(f"{line(row)}{f'  ({len(finished.groups)} of {total}{left})' if len(finished.groups) < total else ''}")

        try:
            return measure(done), None
        except KeyboardInterrupt as stop:
            if not kept:
                raise
            return kept, int(getattr(stop, "number", signal.SIGINT))

    def write_rows(self, data: Mapping[str, object], text: str, files: Mapping[str, Callable[[], bytes]], saved: str = "") -> None:
        """Write the report `output`, if any, in the format of its suffix: one of `files`, `data` as JSON, or `text` as Markdown.

        saved: text for --resume; only JSON and CSV contain it."""
        if self.output is None:
            return
        suffix = self.output.suffix.lower()
        if suffix == ".json":
            self.write(json_text({**data, **({"resume": saved} if saved else {})}))
        elif suffix in files:
            first = f"# resume: {saved}\n" if saved and suffix == ".csv" else ""
            write_bytes(self.output, first.encode() + files[suffix]())
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


def reporting(report: str = "Write the tables as Markdown (.md)", *, cluster: bool = False, resume: bool = False,
              quiet: str = "Print no progress and no warnings") -> Decorator:
    """Return a decorator that adds the options of Reporting. The command receives the object as `how`. report, quiet: help of -o and -q."""
    file = click.option("-o", "--output", type=click.Path(path_type=Path), help=report)
    options: list[Decorator] = [SHARED["as_json"], quiet_option(quiet), file]
    options += [RESUME] if resume else []
    return option_group("how", Reporting, names_of(Reporting), [*options, CLUSTER] if cluster else options)


def planned(plan: type[Plan]) -> Decorator:
    """Return a decorator that adds the options of a Plan (wrt.lab.plans). The command receives the object as `plan`.

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
    known, needed = each.metadata, each.default is MISSING
    kind = TYPES.get(of_type, click.Path(path_type=Path))
    if not known["text"]:
        several: dict[str, Any] = {"nargs": -1, "required": needed} if get_origin(of_type) is Sequence else {}
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
    """Return the command that runs a plan's study (wrt.lab.bench.report.study_of). With --cluster, each worker measures whole meshes."""

    @click.command(plan.COMMAND.split()[-1], help=plan.__doc__)
    @planned(plan)
    @reporting(plan.OUTPUT, cluster="meshes" in plan.__annotations__, resume=True)
    def command(how: Reporting, plan: Plan) -> None:
        from wrt.lab.bench import plot, report
        from wrt.lab.bench.resume import text_of
        from wrt.lab.bench.sweep import by_mesh

        study = report.study_of(plan)
        writers = report.WRITERS | getattr(study, "WRITERS", {})
        suffix = how.check_report((".json", *writers))
        if suffix in (".png", ".svg"):
            plot.new_figure(1.0, 1.0)  # raises InputError if matplotlib is missing
        finished = how.finished(plan)
        client = client_of(how.cluster)
        total = sum(1 for _ in study.groups(plan)) if client is None else 0  # reads all meshes, and so refuses a damaged one at once
        machine = study.machine(plan) if hasattr(study, "machine") else report.machine_line()
        if client is not None:
            from wrt.renderer.distributed.dask import machines

            machine = f"a cluster, each mesh on one worker: {machines(client)}; started from {machine}"
        if finished.groups:
            machine = f"{machine}; resumed after {len(finished.rows)} rows of: {finished.machine}"
        finished.machine = machine
        measure = partial(report.run, finished=finished.groups) if client is None else report.run
        with warnings_reported(how.quiet):
            rows, interrupted = how.rows_of(lambda done: by_mesh(measure, plan, done, client), partial(report.line, plan), finished, total)
        if interrupted is not None:
            machine = f"{machine}; interrupted after {len(rows)} row{'s' if len(rows) > 1 else ''}"
        text, data = report.text(rows, plan, machine), {"machine": machine, **report.data(rows, plan)}
        files = {name: partial(writer, rows, plan, machine, name) for name, writer in writers.items()}
        how.write_rows(data, text, files, text_of(finished, plan) if interrupted is not None and client is None else "")
        how.end(text, {**data, "output": how.output}, interrupted=interrupted)

    return command
