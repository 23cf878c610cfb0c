"""What users give for an argument, checked and brought to one form; an InputError names the argument and what was expected."""

from __future__ import annotations

import difflib
import operator
import os
import re
from collections.abc import Collection, Iterable
from itertools import islice
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import numpy as np

from wrt.core.errors import InputError

T = TypeVar("T")
LARGEST = 1e30  # of any number in a scene: what comes near the end of float32 turns into infinities on the device


def as_integer(value: Any, what: str, low: int, high: int) -> int:
    """A whole number in [low, high]: an int, or NumPy's; no float, even if whole, and no text."""
    try:
        number = operator.index(value)
    except TypeError:
        raise InputError(f"{what} must be a whole number, got {shown(value)}") from None
    if not low <= number <= high:
        raise InputError(f"{what} must be {low} to {high}, got {number}")
    return number


def as_size(value: Any, what: str = "size", high: int = 32768) -> tuple[int, int]:
    """Width and height in pixels from a pair, or from text such as "640x360"."""
    if isinstance(value, str) and (match := re.fullmatch(r"\s*([0-9]{1,9})\s*[xX]\s*([0-9]{1,9})\s*", value)):
        value = (int(match[1]), int(match[2]))
    try:
        width, height = map(operator.index, value if not isinstance(value, str) else ())
    except (TypeError, ValueError):
        raise InputError(f'{what} must be two whole numbers or text such as "640x360", got {shown(value)}') from None
    if not (1 <= width <= high and 1 <= height <= high):
        raise InputError(f"{what} must be 1x1 to {high}x{high}, got {width}x{height}")
    return width, height


def as_array(value: Any, dtype: Any, what: str) -> np.ndarray:
    """A contiguous array; what is beyond the type's range becomes infinite."""
    try:
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(value, dtype=dtype)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be an array of numbers, got {shown(value)}") from None


def as_path(value: Any, what: str) -> Path:
    try:
        return Path(os.fsdecode(value))
    except TypeError:
        raise InputError(f"{what} must be a path, got {shown(value)}") from None


def as_one(value: Any, kind: type[T] | tuple[type[T], ...], what: str) -> T:
    """The value, if it is of that type or one of those types."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not isinstance(value, kinds):
        raise InputError(f"{what} must be {' or '.join(_a(each.__name__) for each in kinds)}, got {shown(value)}")
    return value


def as_tuple(value: Any, kind: type[T] | tuple[type[T], ...], what: str) -> tuple[T, ...]:
    """A sequence of such values; a single one stands for itself."""
    if isinstance(value, kind):
        return (value,)
    if isinstance(value, str) or not hasattr(value, "__iter__"):
        as_one(value, kind, f"{what}: each")
    return tuple(as_one(each, kind, f"{what}[{i}]") for i, each in enumerate(value))


def as_names(value: Any, what: str) -> tuple[str, ...]:
    """Names; a single one stands for itself."""
    if not isinstance(value, Iterable):
        raise InputError(f"{what} must be a name or several, got {shown(value)}")
    return as_tuple(value, str, what)


def as_choice(value: str, choices: Collection[str], what: str) -> str:
    """The value, if it is one of the choices."""
    if value not in choices:
        hint = did_you_mean(value, choices)
        raise InputError(f"{what} must be one of {', '.join(choices)}; got {shown(value)}{'; ' if hint else ''}{hint}".rstrip())
    return value


def require_known(name: str, known: Collection[str], what: str) -> None:
    """Raise InputError where there is no such thing of that name."""
    if name not in known:
        raise InputError(f"no {what} {shown(name)}; {did_you_mean(name, known)}there is {', '.join(known) or 'none'}")


def unknown(name: str, what: str, known: Iterable[str]) -> str:
    """A sentence on a name that is not known, with the nearest one that is, and all of them; long names and lists are cut."""
    names = [str(each) for each in known]
    hint = did_you_mean(name, names)
    return f"unknown {what} {short(name)}; {hint}known are {listed(names, 100)}" if names else (
        f"unknown {what} {short(name)}; there are none")


def listed(names: Collection[str], most: int = 5) -> str:
    """The first of the names, each short, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(short, islice(names, most))) + more


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """A question with the known name that is nearest, for the middle of a message; "" where none is near."""
    names = [each for each in islice(known, 1000) if len(each) <= 100]
    near = difflib.get_close_matches(name[:100], names, n=1) if isinstance(name, str) else []
    return f"did you mean {near[0]!r}? " if near else ""


def at_thing(kind: str, name: str) -> str:
    """How a message begins that is about a thing of that name, or of none."""
    return f"{kind} {name!r}: " if name else f"{kind}: "


def shown(value: Any) -> str:
    """A value as a message shows it: with its type, where it does not tell that itself, and short."""
    if isinstance(value, str | int | float | tuple | list) or value is None:
        return short(value)
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    return _a(type(value).__name__)


def short(value: Any, most: int = 60) -> str:
    """repr(value), cut where it is longer; of what cannot be written, its type."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, tables nested thousands deep
        return f"{_a(type(value).__name__)} too long to show"
    return text if len(text) <= most else text[:most - 3] + "..."


def _a(name: str) -> str:
    return f"{'an' if name[:1] in 'AEIOaeio' else 'a'} {name}"


def accepts(kind: Any, value: Any) -> bool:
    """Whether a value is of an annotation's type: a class, or a union of some. A whole number is a float too, and a bool is no
    number. What is no class (a callable) is not looked at."""
    if get_origin(kind) in (Union, UnionType):
        return any(accepts(each, value) for each in get_args(kind))
    if not isinstance(kind, type):
        return True
    return isinstance(value, (int, float) if kind is float else kind) and (kind is bool or not isinstance(value, bool))
