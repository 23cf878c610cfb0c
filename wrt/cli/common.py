"""What the commands share: types of options, how a scene is loaded, and how they tell of things."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import functools
import importlib
import json
import math
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from wrt.core.errors import InputError, SceneWarning

DIGITS = "[0-9]{1,9}"  # more are no pixel, and Python refuses to read thousands
SEEN = 0.003  # of the pixels: a patch of 26x26 in a picture of 640x360; fewer are seen neither as a patch nor told from noise


class Written(click.ParamType):
    """A value that is written by a pattern. form: how to write it; value: of the groups that the pattern finds."""

    def __init__(self, name: str, pattern: str, form: str, value: Callable[..., Any]) -> None:
        self.name, self.pattern, self.form, self.value = name, pattern, form, value

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        match = re.fullmatch(self.pattern, str(value))
        if not match:
            self.fail(f"{value!r} is not {self.form}", param, ctx)
        return self.value(*match.groups())


SIZE = Written("WxH", f"({DIGITS})[xX]({DIGITS})", "a size; write 640x360", lambda *sides: tuple(map(int, sides)))
CROP = Written("X0,Y0,X1,Y1", ",".join([rf"\s*({DIGITS})\s*"] * 4),
               "a rectangle; write X0,Y0,X1,Y1 in pixels from the top left", lambda *ends: tuple(map(int, ends)))
DURATION = Written("TIME", r"([0-9]+(?:\.[0-9]*)?)\s*([smh]?)", "a time; write 30s, 5m or 1h",
                   lambda number, unit: float(number) * {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}[unit])


class Names(click.ParamType):
    """Comma-separated names."""

    name = "NAME,..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        if isinstance(value, tuple):  # the default
            return value
        return tuple(name.strip() for name in str(value).split(",") if name.strip())


class Commands(click.Group):
    """Commands; a name that is none is answered with those that there are, an option that is none with the nearest one."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except click.NoSuchOption as error:  # click compares with the dashes, which are always alike
            known = {name.strip("-") for each in error.ctx.command.params for name in each.opts} if error.ctx else set()
            meant = {"--width": "size", "--height": "size"}.get(error.option_name, error.option_name.strip("-"))
            near = "".join(f" Did you mean '--{each}'?" for each in difflib.get_close_matches(meant, known, n=1))
            raise click.UsageError(f"No such option {error.option_name!r}.{near}", error.ctx) from None

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            if self.get_command(ctx, args[0]) is None and "No such command" in error.format_message():
                from wrt.core.checks import did_you_mean

                known = self.list_commands(ctx)
                ctx.fail(f"No such command {args[0]!r}; {did_you_mean(args[0], known)}there is {', '.join(known)}")
            raise


class OneOf(click.ParamType):
    """One name of a table, given as "module:TABLE". It is only shown, by --help and by completion in a shell: whoever takes the
    option checks it against the table, and tells the nearest name."""

    name = "NAME"

    def __init__(self, place: str) -> None:
        self.place = place

    def names(self) -> list[str]:
        """The table's, whose module is imported now."""
        module, table = self.place.split(":")
        return list(getattr(importlib.import_module(module), table))

    def get_metavar(self, param: Any, ctx: Any = None) -> str:
        return f"[{'|'.join(self.names())}]"

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]


ACCEL = OneOf("wrt.accel.structures:ACCELERATORS")


class Setting(click.ParamType):
    """NAME=VALUE; the value is a number, True, False or a word."""

    name = "NAME=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, Any]:
        name, sign, text = str(value).partition("=")
        if not sign or not name:
            self.fail(f"{value!r} is not NAME=VALUE", param, ctx)
        try:
            parsed = ast.literal_eval(text)
        except (ValueError, SyntaxError, MemoryError, RecursionError):
            parsed = text
        return name, parsed if isinstance(parsed, bool | int | float | str) else text


class SceneSetting(Setting):
    """A setting of a scene."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, Any]:
        name, parsed = super().convert(value, param, ctx)
        return name, str(value).partition("=")[2] if name == "size" else parsed  # 0x360 is no number


SET = click.option(
    "--set", "given", type=SceneSetting(), multiple=True,
    help="A setting of the scene, such as glass_shadows=tinted; repeatable. There is size, spp, max_depth, min_throughput, filter,"
         " fresnel, glass_shadows, sampler, exposure and tonemap (docs/scene_format.md)")


# What several commands take, by the names of the arguments.
SHARED = {
    "scene": click.argument("scene", type=click.Path(path_type=Path)),
    "spp": click.option("--spp", type=int, help="Samples a pixel  [default: the scene's]"),
    "size": click.option("--size", type=SIZE, help="Pixels  [default: the scene's, 640x360]"),
    "max_depth": click.option("--max-depth", type=int, help="Bounces after the first hit  [default: the scene's; 8, glass 64]"),
    "crop": click.option("--crop", type=CROP, help="Render only this rectangle, in pixels from the top left"),
    "camera": click.option("--camera", help="A camera's name or number  [default: the first]"),
    "given": SET,
    "seed": click.option("--seed", type=int, default=0, show_default=True, help="Another seed, another noise"),
    "device": click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)"),
    "threads": click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]"),
    "accel": click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure"),
    "quiet": click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings"),
    "as_json": click.option("--json", "as_json", is_flag=True, help="Print as JSON"),
}


def shared(*names: str) -> Callable[[Any], Any]:
    """A command with these of SHARED."""
    return lambda command: functools.reduce(lambda wrapped, name: SHARED[name](wrapped), reversed(names), command)


def names_of(kind: type[Any]) -> list[str]:
    """Return the names of a dataclass's fields."""
    return [each.name for each in dataclasses.fields(kind)]


def gathering(name: str, make: Callable[..., Any], names: Sequence[str], options: Sequence[Any]) -> Callable[[Any], Any]:
    """Give a command these options, of which it gets one argument of that name: what `make` makes of them. names: those of the
    options, and perhaps of others."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def gathered(**given: Any) -> None:
            own = {each: given.pop(each) for each in names if each in given}
            command(**given, **{name: make(**own)})

        return functools.reduce(lambda wrapped, option: option(wrapped), options, gathered)

    return decorate


def settings_of(given: tuple[tuple[str, Any], ...], flags: dict[str, Any] | None = None, **taken: str) -> dict[str, Any]:
    """The settings that --set gives, and those of `flags`, which are flags of their own (None: not given).

    taken: settings that this command does not take from --set, each with who decides on it. Values are checked as those of a
    scene file are. Raises InputError for them, and where a setting is given twice and not the same.
    """
    from wrt.core.checks import as_size
    from wrt.io.toml.report import check_settings

    if not given:
        return dict(flags or {})
    values: dict[str, Any] = {}
    for name, value in given:
        if name in taken:
            raise InputError(f"{taken[name]} decides on that here", argument=f"--set {name}")
        if name in values and values[name] != value:
            raise InputError(f"given twice, {values[name]!r} and {value!r}", argument=f"--set {name}")
        values[name] = value
    if "size" in values:
        values["size"] = list(as_size(values["size"], "--set size"))
    settings = check_settings(values, "--set")
    for name, value in (flags or {}).items():
        if value is not None and name in settings and _plain(settings[name]) != _plain(value):
            raise InputError(f"--{name.replace('_', '-')} is given too, and says otherwise: leave one of them out",
                             argument=f"--set {name}")
    return {**{name: value for name, value in (flags or {}).items() if value is not None}, **settings}


def _plain(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | tuple) else value


def depth_hint(visibly_cut: float, max_depth: int, option: str = "--max-depth") -> str | None:
    """A line for who may want more bounces: where so many pixels lack light visibly (Film.stats) that somebody would see them."""
    from wrt.scene.settings import MAX_DEPTH

    if visibly_cut < SEEN:
        return None
    advice = f"raise {option}" if max_depth < MAX_DEPTH else f"{MAX_DEPTH} is the most there is"
    return f"max_depth {max_depth} leaves {100.0 * visibly_cut:.2g}% of the pixels visibly too dark: {advice}"


def spread_options(cluster: str | None, device: str) -> dict[str, Any]:
    """The options of `wrt.render` for --cluster and --device; a cluster's connection is open until the command ends."""
    names = [name.strip() for name in device.split(",")]
    if cluster is None:
        return {"device": device} if len(names) == 1 else {"devices": names}
    if len(names) > 1:
        raise InputError("with --cluster it is that of each worker, and one; start a worker for each device",
                         argument="--device")
    return {"device": device, "executor": client_of(cluster)}


def client_of(cluster: str | None) -> Any:
    """A dask.distributed.Client that is open until the command ends; None of None."""
    if cluster is None:
        return None
    from wrt.renderer.distributed.dask import connected

    return click.get_current_context().with_resource(connected(cluster))


CLUSTER = click.option("--cluster", metavar="ADDRESS",
                       help="Spread over the workers of a Dask scheduler, tcp://host:8786 (docs/cluster.md)")


def load(path: Path, quiet: bool) -> Any:
    """The scene, with the loader's warnings on stderr."""
    from wrt.io.load import load_scene

    with warnings_reported(quiet):
        return load_scene(path)


@contextlib.contextmanager
def warnings_reported(quiet: bool) -> Iterator[None]:
    """Tell the block's warnings on stderr when it is over, a line each; none where it fails: one message is enough."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SceneWarning)
        yield
    for warning in caught:
        if not (quiet and issubclass(warning.category, SceneWarning)):
            say(f"warning: {warning.message}")


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """What is found wrong with a scene after it was read is told with its file; what is wrong with another file names that."""
    try:
        yield
    except InputError as error:
        if error.path is not None:
            raise
        raise error.at(path) from error


def json_text(value: Any) -> str:
    """As JSON, which has no NaN and no infinity: they become null; what it has no form for becomes text."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(value), default=str, allow_nan=False)


def say_json(value: Any) -> None:
    """As JSON on stdout."""
    click.echo(json_text(value))


def say(text: object, err: bool = True) -> None:
    """On stderr, where a terminal that is gone is no reason to fail, or on stdout. Control characters that a stranger's file or its
    name holds are escaped: they give the terminal no orders."""
    text = re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", lambda control: f"\\x{ord(control[0]):02x}", str(text))
    with contextlib.suppress(OSError) if err else contextlib.nullcontext():
        click.echo(text, err=err)


def now_and_then(quiet: bool, every: float = 10.0) -> Callable[[str], None]:
    """Where lines of progress go: on a terminal each one over the last, else one in `every` seconds."""
    terminal = sys.stderr is not None and sys.stderr.isatty()
    due = time.monotonic()

    def tell(line: str) -> None:
        nonlocal due
        if terminal:
            with contextlib.suppress(OSError):
                click.echo(f"\r\x1b[2K{line[:100]}\r", err=True, nl=False)
        elif time.monotonic() >= due:
            due = time.monotonic() + every
            say(line)

    return (lambda line: None) if quiet else tell
