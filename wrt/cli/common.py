"""Parts that the commands share: types of options, loading of scenes, and output."""

import contextlib
import functools
import importlib
import json
import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import click

from wrt.core.errors import InputError, SceneWarning
from wrt.core.settings import DEFAULT_DEVICE
from wrt.scene.kinds import forms
from wrt.scene.settings import MAX_DEPTH, SETTINGS, Settings

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from wrt.scene.model import Scene
    from wrt.scene.settings import SettingChanges

Decorator: TypeAlias = Callable[[Callable[..., None]], Callable[..., None]]
Parsed: TypeAlias = Any  # The value of an option, which click has converted to the option's type.
Assignments: TypeAlias = tuple[str, ...]  # The texts NAME=VALUE of all --set options.
BROKEN_PIPE = 141  # Exit code: 128 plus the number of SIGPIPE, which Windows does not have.
DIGITS = "[0-9]{1,9}"  # A pixel coordinate. Longer numbers are an error, as Python refuses thousands of digits.


class PatternType(click.ParamType):
    """Text that matches a regular expression. form: the pattern in words, for errors. value: function from the groups to the value."""

    def __init__(self, name: str, pattern: str, form: str, value: Callable[..., object]) -> None:
        self.name, self.pattern, self.form, self.value = name, pattern, form, value

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> object:
        match = re.fullmatch(self.pattern, str(value))
        if not match:
            self.fail(f"{value!r} is not {self.form}", param, ctx)
        return self.value(*match.groups())


SIZE = PatternType("W[xH]", f"({DIGITS})(?:[xX]({DIGITS}))?", "a size; write 640x360, or 640 for a width",
                   lambda width, height: (int(width), int(height)) if height else int(width))
CROP = PatternType("X0,Y0,X1,Y1", ",".join([rf"\s*({DIGITS})\s*"] * 4),
                   "a rectangle; write X0,Y0,X1,Y1 in pixels from the top left", lambda *ends: tuple(map(int, ends)))
DURATION = PatternType("TIME", r"([0-9]+(?:\.[0-9]*)?)\s*([smh]?)", "a time; write 30s, 5m or 1h",
                       lambda number, unit: float(number) * {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}[unit])

EXPOSURE = PatternType("STOPS|auto", r"(auto|[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|nan|[-+]?inf)",
                       "an exposure; write stops such as -1.5, or auto",
                       lambda stops: stops if stops == "auto" else float(stops))


class Names(click.ParamType):
    """Comma-separated names."""

    name = "NAME,..."

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        if isinstance(value, tuple):  # the default
            return value
        return tuple(name.strip() for name in str(value).split(",") if name.strip())


class Commands(click.Group):
    """A group of commands whose help leaves out the broken entry points of other packages, with a warning."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        with warnings_reported(False):
            return sorted(name for name, _ in self.commands.items())

    def invoke(self, ctx: click.Context) -> object:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # the reader of stdout has ended; click would exit with 1
            raise SystemExit(BROKEN_PIPE) from None


class OneOf(click.ParamType):
    """A name in a table, such as an acceleration structure. place: the table, or "module:TABLE", which --help imports.

    This type lists the names for --help and completion. It does not check them: the function that receives the name does."""

    name = "NAME"

    def __init__(self, place: str | Sequence[str]) -> None:
        self.place = place

    def names(self) -> list[str]:
        """Return the table's names."""
        if not isinstance(self.place, str):
            return list(self.place)
        module, table = self.place.split(":")
        return list(getattr(importlib.import_module(module), table))

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{'|'.join(self.names())}]"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> "list[CompletionItem]":
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]


ACCEL = OneOf("wrt.accel.structures:ACCELERATORS")


def silence(context: click.Context, option: click.Parameter, quiet: bool) -> bool:
    """Report no compilation of kernels in a quiet command."""
    if quiet:
        from wrt.core.compiling import WATCH

        context.with_resource(WATCH.reported_by_caller())
    return quiet


def setting(name: str, more: str = "") -> Decorator:
    """Return the option that changes a setting of the scene. The field of Settings gives its type and help, which ends with `more`."""
    described = forms(Settings)[name].metadata
    types = {"whole": int, "number": float, "size": SIZE, "choice": OneOf(described["limits"].get("among", ()))}
    about, unit = described["about"], f" in {described['unit']}" if described["unit"] in ("pixels", "stops") else ""
    return click.option(f"--{name.replace('_', '-')}", name, type=EXPOSURE if name == "exposure" else types[described["form"]],
                        help=f"{about[:1].upper()}{about[1:]}{unit}{more}  [default: the scene's]")


# Options and arguments that several commands share, by the name of the command function's parameter.
SHARED: dict[str, Decorator] = {
    "scene": click.argument("scene", type=click.Path(path_type=Path)),
    "crop": click.option("--crop", type=CROP, help="Render only this rectangle, in pixels from the top left"),
    "camera": click.option("--camera", help="Name or index of a camera in the scene  [default: the first]"),
    "assignments": click.option(
        "--set", "assignments", metavar="NAME=VALUE", multiple=True,
        help="Change a setting of the scene, such as glass_shadows=tinted; repeatable. The settings are"
             f" {', '.join(SETTINGS)} (docs/scene_format.md)"),
    "seed": click.option("--seed", type=int, default=0, show_default=True, help="Seed of the samples: another seed gives other noise"),
    "device": click.option("--device", default=DEFAULT_DEVICE, show_default=True, help="cpu, cuda:0 ... (`devices` lists them)"),
    "threads": click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]"),
    "accel": click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure"),
    "quiet": click.option("-q", "--quiet", is_flag=True, help="Print no progress and no warnings", callback=silence),
    "as_json": click.option("--json", "as_json", is_flag=True, help="Print the result as JSON"),
    **{name: setting(name) for name in ("spp", "max_depth", "min_throughput", "clamp", "filter", "fresnel", "sampler", "tonemap")},
    "size": setting("size", ", or a width, which keeps the scene's aspect ratio"),
    "exposure": setting("exposure", ", or auto: bright parts are shown just below white"),
}


def shared(*names: str) -> Decorator:
    """Return a decorator that adds the entries `names` of SHARED, options and arguments, to a command."""
    return lambda command: functools.reduce(lambda wrapped, name: SHARED[name](wrapped), reversed(names), command)


def option_group(name: str, options: Mapping[str, Decorator]) -> Decorator:
    """Return a decorator that adds `options`, by the name of their value. The command receives the values as its argument `name`."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def with_group(**values: Parsed) -> None:
            command(**{name: {each: values.pop(each) for each in options}}, **values)

        wrapped: Callable[..., None] = with_group
        for option in options.values():
            wrapped = option(wrapped)
        return wrapped

    return decorate


def settings_of(assignments: Sequence[str], options: dict[str, Parsed] | None = None, **reserved: str) -> "SettingChanges":
    """Return changes of the scene's settings from --set, and from options such as --spp, which are removed from `options` (None: absent).

    reserved: see `assigned`. Raises InputError for an invalid setting, and if --set and an option give different values."""
    from wrt.core.checks import as_size, assigned
    from wrt.io.toml.report import check_settings

    options = options or {}
    flags = {name: options.pop(name) for name in SETTINGS if name in options}
    if flags.get("exposure") == "auto":
        flags |= {"exposure": None, "auto_exposure": True}
    flags = {name: value for name, value in flags.items() if value is not None}
    values: dict[str, Parsed] = dict(assigned(assignments, "--set", reserved))
    if "size" in values:
        values["size"] = list(as_size(values["size"], "--set size"))
    settings = check_settings(values, "--set") if values else {}
    for name, value in flags.items():
        if name in settings and (tuple(settings[name]) if name == "size" else settings[name]) != value:
            raise InputError(f"and --{name.replace('_', '-')} have different values", argument=f"--set {name}", hint="give one of them")
    return cast("SettingChanges", {**flags, **settings})


def depth_hint(stats: dict[str, Any], max_depth: int, option: str = "--max-depth ") -> str | None:
    """Return advice on max_depth, or None if few pixels are visibly too dark. stats: Film.stats."""
    from wrt.renderer.film import FEW

    if stats["visibly_cut"] < FEW:
        return None
    advice = f"try {option}{stats['needed_depth']}" if max_depth < MAX_DEPTH else f"{MAX_DEPTH} is the maximum"
    return (f"max_depth {max_depth} leaves {100.0 * stats['visibly_cut']:.2g}% of the pixels visibly too dark; in surroundings of"
            f" radiance 1, the cut rays would add {stats['lost_by_depth']:.2g} to the picture's mean: {advice}")


STAGING = option_group("staging", {
    "up": click.option("--up", type=OneOf("wrt.scene.defaults:UP"), default="y", show_default=True,
                       help="Axis of a mesh file that points up"),
    "studio": click.option("--studio/--no-studio", default=True, show_default=True,
                           help="Light a file without lights by a studio, which glass and smooth surfaces reflect, or by a pale sky"),
    "floor": click.option("--floor", is_flag=True, help="Put a mesh file on a grey floor"),
    "fill": click.option("--fill", type=float, help="Radiance of a fill light beside a glTF file's own lights"
                                                    "  [default: 0, or an estimate beside emissive surfaces]")})


def load(path: Path, quiet: bool, staging: dict[str, Parsed] | None = None) -> "Scene":
    """Read a scene, and write the loader's warnings to stderr. staging: keywords of load_scene, the values of STAGING's options."""
    from wrt.io.load import load_scene

    with warnings_reported(quiet):
        return load_scene(path, **staging or {})


@contextlib.contextmanager
def warnings_reported(quiet: bool) -> Iterator[None]:
    """Write the warnings of the `with` block to stderr when it ends, one per line. If the block fails, write none: its error is enough."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SceneWarning)
        yield
    for warning in caught:
        if not (quiet and issubclass(warning.category, SceneWarning)):
            say(f"warning: {warning.message}")


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the scene's path to an InputError of the `with` block, if the error has no path: it was raised after reading."""
    try:
        yield
    except InputError as error:
        if error.path is not None:
            raise
        raise error.at(path) from error


def json_text(value: object) -> str:
    """Return a value as JSON. NaN and infinity become null; values that JSON cannot express become text."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(value), default=str, allow_nan=False)


def say_json(value: object) -> None:
    """Write a value as JSON to stdout."""
    click.echo(json_text(value))


def say(text: object, err: bool = True) -> None:
    """Write a line to stderr (err=False: stdout), with control characters escaped. A closed stderr is no error."""
    text = re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", lambda control: f"\\x{ord(control[0]):02x}", str(text))
    with contextlib.suppress(OSError) if err else contextlib.nullcontext():
        click.echo(text, err=err)
