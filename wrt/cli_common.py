"""What the commands share: types of options, how a scene is loaded, and how they tell of things."""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from wrt.errors import InputError, SceneWarning

DIGITS = "[0-9]{1,9}"  # more are no pixel, and Python refuses to read thousands


class Size(click.ParamType):
    """640x360"""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(f"({DIGITS})[xX]({DIGITS})", str(value))
        if not match:
            self.fail(f"{value!r} is not a size; write 640x360", param, ctx)
        return int(match[1]), int(match[2])


class Crop(click.ParamType):
    """X0,Y0,X1,Y1"""

    name = "X0,Y0,X1,Y1"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        numbers = [number.strip() for number in str(value).split(",")]
        if len(numbers) != 4 or not all(re.fullmatch(DIGITS, number) for number in numbers):
            self.fail(f"{value!r} is not a rectangle; write X0,Y0,X1,Y1 in pixels from the top left", param, ctx)
        return tuple(int(number) for number in numbers)


class Duration(click.ParamType):
    """30, 30s, 5m or 1h"""

    name = "TIME"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]*)?)\s*([smh]?)", str(value))
        if not match:
            self.fail(f"{value!r} is not a time; write 30s, 5m or 1h", param, ctx)
        return float(match[1]) * {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}[match[2]]


class Names(click.ParamType):
    """Comma-separated names."""

    name = "NAME,..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        if isinstance(value, tuple):  # the default
            return value
        return tuple(name.strip() for name in str(value).split(",") if name.strip())


def spread_options(cluster: str | None, device: str) -> dict[str, Any]:
    """The options of `wrt.render` for --cluster and --device; a cluster's connection is open until the command ends."""
    names = [name.strip() for name in device.split(",")]
    if cluster is None:
        return {"device": device} if len(names) == 1 else {"devices": names}
    if len(names) > 1:
        raise InputError(f"--device {device}: with --cluster it is that of each worker, and one; start a worker for each device")
    return {"device": device, "executor": client_of(cluster)}


def client_of(cluster: str | None) -> Any:
    """A dask.distributed.Client that is open until the command ends; None of None."""
    if cluster is None:
        return None
    from wrt.cluster import connected

    return click.get_current_context().with_resource(connected(cluster))


CLUSTER = click.option("--cluster", metavar="ADDRESS",
                       help="Spread over the workers of a Dask scheduler, tcp://host:8786 (docs/cluster.md)")


def load(path: Path, quiet: bool, clock: dict[str, float] | None = None) -> Any:
    """The scene, with the loader's warnings on stderr."""
    begin = time.perf_counter()
    from wrt.scene_file import load_scene

    with warnings_told(quiet):
        scene = load_scene(path)
    if clock is not None:
        clock["load"] = time.perf_counter() - begin
    return scene


@contextlib.contextmanager
def warnings_told(quiet: bool) -> Iterator[None]:
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
        raise InputError(str(error), path) from error


def say_json(value: Any) -> None:
    """As JSON on stdout, which has no NaN and no infinity: they become null."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    click.echo(json.dumps(plain(value), default=str, allow_nan=False))


def say(text: str) -> None:
    """On stderr; that its terminal is gone is no reason to fail. What a stranger's file quotes gives the terminal no orders."""
    text = re.sub(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", lambda control: f"\\x{ord(control[0]):02x}", text)
    with contextlib.suppress(OSError):
        click.echo(text, err=True)


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
