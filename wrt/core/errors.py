"""InputError, for every mistake of a user: the command line prints its message and exits with code 2. SceneWarning, for scene files."""

from __future__ import annotations

import copy
import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
# Longest line of a message, in characters, because messages quote files; and how many of them come from the end of a longer line.
LONGEST, END = 5000, 1000
PREDICATE = re.compile(r"(must|is|are|has|have|holds?|needs?|requires?|shares|cannot|does|do|takes|puts|spans?|belongs?|and|or)\b")


class InputError(ValueError):
    """Input that cannot be used: a file, a scene, an option.

    The parameters are attributes of the error. `str` gives the message: where, what is wrong, what would be right. If one file
    includes another, `path` is the included file, and `outside` says where the first file names it: "scene.toml: include[0]".

    Parameters
    ----------
    what : what is wrong: a predicate of the argument ("must be 1 or more, got 0"), or a complete sentence
    argument : name of the argument, option or field that is wrong
    path : the file that is wrong
    place : where in the file, or in which object: "nodes[3].scale", "line 7", "camera 'main'"
    hint : what would be right, or what to do
    """

    def __init__(self, what: str, *, argument: str | None = None, path: str | os.PathLike[str] | None = None,
                 place: str | None = None, hint: str | None = None) -> None:
        super().__init__(what)
        self.what, self.argument, self.path, self.place, self.hint = what, argument, path, place, hint
        self.outside: str | None = None

    def __str__(self) -> str:
        what, name = self.what, self.argument or ""
        if name and PREDICATE.match(what):
            what = f"{name} {what}"
        elif name and not re.search(rf"\b{re.escape(name)}\b", what, re.IGNORECASE):  # the sentence does not name the argument
            what = f"{name}: {what}"
        lines = _joined(self.outside, self.path, self.place, f"{what}; {self.hint}" if self.hint else what).split("\n")
        return "\n".join(line if len(line) <= LONGEST else f"{line[:LONGEST - END - 3]}...{line[-END:]}" for line in lines)

    def __reduce__(self) -> Any:
        return _restore, (type(self), self.args, self.__dict__)

    def at(self, path: str | os.PathLike[str] | None = None, place: str | None = None, hint: str | None = None) -> Self:
        """Return a copy of the error with a file, a place and a further hint. If it has a file already, the new file includes that one."""
        error = copy.copy(self)
        if self.path is None:
            vars(error).update(path=path, place=_joined(place, self.place) or None)
        else:
            vars(error).update(outside=_joined(path, place, self.outside) or None)
        vars(error).update(hint="; ".join(filter(None, (self.hint, hint))) or None)
        return error


class InputErrors(InputError):
    """Several errors at once, in `errors`; the message has a line for each."""

    def __init__(self, what: str, errors: Sequence[InputError], *, path: str | os.PathLike[str] | None = None) -> None:
        super().__init__(what, path=path)
        self.errors = tuple(errors)


def wrong(name: str, what: str, hint: str | None = None) -> InputError:
    """Return the error about an argument. In `name`, its place may precede its name: "camera 'main': fov_y"."""
    place, _, argument = name.rpartition(": ")
    return InputError(what, argument=argument, place=place or None, hint=hint)


def _restore(kind: type[InputError], args: tuple[Any, ...], fields: dict[str, Any]) -> InputError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(fields)
    return error


def _joined(*parts: str | os.PathLike[str] | None) -> str:
    return ": ".join(os.fspath(part) for part in parts if part)


@contextmanager
def at(place: str | None = None, path: str | os.PathLike[str] | None = None) -> Iterator[None]:
    """Add a file or a place, such as "nodes[3].scale", to any InputError that the block raises."""
    try:
        yield
    except InputError as error:
        raise error.at(path, place) from error


class SceneWarning(UserWarning):
    """A scene file holds something that wrt leaves out or replaces; the picture may differ from the author's."""


def warn(message: str) -> None:
    """Issue a SceneWarning that points to the line outside of wrt that led to it."""
    frame, level = sys._getframe(1), 2  # of warnings.warn: 1 is this function
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):  # skip_file_prefixes is of Python 3.12
        frame, level = frame.f_back, level + 1
    warnings.warn(message, SceneWarning, stacklevel=level)
