"""Files of a long render: its checkpoint, and a second folder for a picture that cannot be written to the first."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from wrt.core.errors import InputError
from wrt.core.interrupts import held_interrupts

if TYPE_CHECKING:
    from wrt.picture.film import Film

EVERY = 60.0  # seconds between two checkpoints
SUFFIX = ".checkpoint"  # appended to the picture's name


def checkpoint_options(output: Path, every: float | None, file: Path | None, resume: bool) -> dict[str, object]:
    """Return the options of `wrt.render` for --checkpoint, --checkpoint-file and --resume; empty if all three are absent."""
    if every is None and file is None and not resume:
        return {}
    file = file or output.with_name(output.name + SUFFIX)
    if os.path.realpath(file) == os.path.realpath(output):
        raise InputError("is the picture; a checkpoint needs a file of its own", path=file)
    return {"checkpoint": file, "checkpoint_every": EVERY if every is None else every, "resume": resume}


def save_film(film: "Film", output: Path, bits: int | None, layers: Sequence[str] | None
              ) -> tuple[list[Path], list[int], InputError | None]:
    """Write the picture to `output`. If that fails, write it to a new folder wrt-* in the folder for temporary files (TMPDIR).

    Returns the paths written, the numbers of the signals that arrived meanwhile, and the error if writing to `output` failed. Raises
    InputError if both folders fail."""
    with held_interrupts() as signals:
        try:
            return film.save(output, bits=bits, aov=layers), signals, None
        except InputError as error:
            with contextlib.suppress(OSError, InputError):
                folder = Path(tempfile.mkdtemp(prefix="wrt-"))
                try:
                    return film.save(folder / output.name, bits=bits, aov=layers), signals, error
                except InputError:
                    shutil.rmtree(folder, ignore_errors=True)
            raise


def write_to_stdout(film: "Film", bits: int | None) -> tuple[list[Path], list[int], InputError | None]:
    """Write the picture to stdout as a PNG file. The result is that of save_film, without paths."""
    from wrt.picture.image import encode_png
    from wrt.picture.tonemap import to_codes

    codes = to_codes(film.pixels, film.exposure, film.tonemap, bits or 8)
    with held_interrupts() as signals:
        click.echo(encode_png(codes, film.metadata), nl=False)
    return [], signals, None


def remove_checkpoint(path: Path) -> None:
    """Remove the checkpoint of a finished picture. Raises InputError if that fails."""
    if path.is_dir():  # not written by wrt; the render has warned that the checkpoint is not saved
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot be removed: {error.strerror}",
                         path=path, hint="remove this checkpoint by hand; the picture is finished") from error
