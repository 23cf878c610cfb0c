"""The one error a user's mistake turns into: the command line prints its message and exits with 2."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
LONGEST, END = 5000, 1000  # characters of a line of a message, which may quote what stands in a file; those kept of its end


class InputError(ValueError):
    """Input that cannot be used: a file, a scene, an option.

    The message names the file and the place in it (`path: place: what is wrong`), so that it can be shown as it is.
    """

    def __init__(self, message: str, path: str | os.PathLike[str] | None = None, place: str | None = None) -> None:
        self.path = path
        message = "\n".join(line if len(line) <= LONGEST else f"{line[:LONGEST - END - 3]}...{line[-END:]}"
                            for line in message.split("\n"))
        parts = [os.fspath(path) if path is not None else None, place, message]
        super().__init__(": ".join(part for part in parts if part))

    def at(self, path: str | os.PathLike[str] | None = None, place: str | None = None) -> InputError:
        """The same, found in that file or at that place of it."""
        return InputError(str(self), path, place)


@contextmanager
def at(place: str | None = None, path: str | os.PathLike[str] | None = None) -> Iterator[None]:
    """Put a file, or a place such as "nodes[3].scale", in front of any InputError raised inside."""
    try:
        yield
    except InputError as error:
        raise error.at(path, place) from error


class SceneWarning(UserWarning):
    """Something in a scene file that wrt leaves out or replaces; the picture may differ from the author's."""


def warn(message: str) -> None:
    """Give a SceneWarning, shown at the line outside of wrt that led to it."""
    frame, level = sys._getframe(1), 2  # of warnings.warn: 1 is this function
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):  # skip_file_prefixes is of Python 3.12
        frame, level = frame.f_back, level + 1
    warnings.warn(message, SceneWarning, stacklevel=level)
