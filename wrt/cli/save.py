"""How the command line keeps what a long render made: its checkpoint, and a place for the picture where the first is full."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import click

from wrt.cli.common import say
from wrt.core.errors import InputError
from wrt.core.interrupts import held_interrupts

EVERY = 60.0
SUFFIX = ".checkpoint"  # after the picture's name
PACKED = 4  # a picture's file is rarely smaller than its colours over this


def checkpoint_options(output: Path, every: float | None, file: Path | None, resume: bool) -> dict[str, Any]:
    """The options of `wrt.render` for --checkpoint, --checkpoint-file and --resume; none of them is no checkpoint."""
    if every is None and file is None and not resume:
        return {}
    file = file or output.with_name(output.name + SUFFIX)
    if os.path.realpath(file) == os.path.realpath(output):
        raise InputError("is the picture; a checkpoint needs a file of its own", file)
    return {"checkpoint": file, "checkpoint_every": EVERY if every is None else every, "resume": resume}


def check_room(output: Path, size: tuple[int, int], bits: int | None) -> None:
    """Raise InputError where the disk is too full for a picture of that size, in pixels."""
    needed = size[0] * size[1] * 3 * (bits or (32 if output.suffix.lower() == ".exr" else 8)) // 8 // PACKED
    free = shutil.disk_usage(Path(os.path.realpath(output)).parent).free
    if free < needed:
        raise InputError(f"cannot be written: its disk has {free / 2**20:.1f} MiB left, and a picture of {size[0]}x{size[1]} takes"
                         f" {needed / 2**20:.1f} or more", output)


def save_film(film: Any, output: Path, bits: int | None, layers: Any) -> tuple[list[Path], list[int], InputError | None]:
    """Write the picture in any case: what was rendered is never thrown away for a full disk.

    Where `output` cannot be written, another place is asked for on a terminal; else, or where the answer is empty, it goes into
    a new folder wrt-* in the folder for temporary files (TMPDIR), or in the home folder. Returns the paths written, the numbers
    of the signals that came meanwhile, and the error where the picture is not where somebody said. Raises InputError where
    no place takes it.
    """
    came: list[int] = []
    target: Path | None = output
    first: InputError | None = None
    while target is not None:
        with held_interrupts() as late:  # a picture that is there is written in any case
            try:
                return film.save(target, bits=bits, aov=layers), [*came, *late], None
            except InputError as error:
                first = first or error
                problem = error
        came += late
        target = _another_place(problem)
    assert first is not None
    for folder in (tempfile.gettempdir(), Path.home()):
        with contextlib.suppress(OSError, InputError), held_interrupts() as late:
            place = Path(tempfile.mkdtemp(prefix="wrt-", dir=folder))
            try:
                return film.save(place / output.name, bits=bits, aov=layers), [*came, *late], first
            except InputError:
                shutil.rmtree(place, ignore_errors=True)
    raise first


def _another_place(problem: InputError) -> Path | None:
    """What somebody at the terminal answers; None where nobody is there, or has no answer."""
    if not _at_a_terminal():
        return None
    say(f"error: {problem}")
    try:
        answer = click.prompt("The picture is kept in memory. Another file for it (empty: a folder for temporary files)",
                              default="", show_default=False, err=True)
    except (click.Abort, KeyboardInterrupt, OSError):
        return None
    return Path(answer) if answer.strip() else None


def _at_a_terminal() -> bool:
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr))
