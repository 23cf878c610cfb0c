"""Checks of arguments, which also convert them. `what` names the argument, if need be after its place: "camera 'main': fov_y"."""

import difflib
import operator
import os
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from types import UnionType
from typing import TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt

from wrt.core.errors import InputError, wrong

T = TypeVar("T")
LARGEST = 1e30  # largest absolute value of a number in a scene; float32 ends at 3.4e38


def as_integer(value: object, what: str, low: int, high: int) -> int:
    """Return a Python or NumPy integer in [low, high] as int. Raises InputError for other values, even for the float 1.0."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise wrong(what, f"must be a whole number, got {shown(value)}") from None
    if not low <= number <= high:
        raise wrong(what, f"must be {low} to {high}, got {number}")
    return number


def as_size(value: object, what: str = "size", high: int = 32768) -> tuple[int, int]:
    """Return width and height in pixels, 1 to `high` each, from a pair or a text such as "640x360"."""
    if isinstance(value, str) and (match := re.fullmatch(r"\s*([0-9]{1,9})\s*[xX]\s*([0-9]{1,9})\s*", value)):
        value = (int(match[1]), int(match[2]))
    try:
        width, height = map(operator.index, () if isinstance(value, str) else value)  # type: ignore[call-overload]
    except (TypeError, ValueError):
        raise wrong(what, f'must be two whole numbers or text such as "640x360", got {shown(value)}') from None
    if not (1 <= width <= high and 1 <= height <= high):
        raise wrong(what, f"must be 1x1 to {high}x{high}, got {width}x{height}")
    return width, height


def as_array(value: object, dtype: npt.DTypeLike, what: str) -> np.ndarray:
    """Return a contiguous array of a type, with one axis or more. Values beyond the range of a float type become infinite.
    It is a copy, because the caller may write to its array later; only read-only arrays that own their memory are shared."""
    shared = isinstance(value, np.ndarray) and value.base is None and not value.flags.writeable
    try:
        with np.errstate(over="ignore"):
            return np.array(value, dtype, copy=None if shared else True, order="C", ndmin=1)
    except (TypeError, ValueError):
        raise wrong(what, f"must be an array of numbers, got {shown(value)}") from None


def as_path(value: object, what: str) -> Path:
    try:
        return Path(os.fsdecode(value))  # type: ignore[arg-type]
    except TypeError:
        raise wrong(what, f"must be a path, got {shown(value)}") from None


def as_one(value: object, kind: type[T] | tuple[type[T], ...], what: str, hint: str | None = None) -> T:
    """Return the value. Raises InputError, with the hint, unless it is an instance of `kind`."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not isinstance(value, kinds):
        raise wrong(what, f"must be {' or '.join(_a(each.__name__) for each in kinds)}, got {shown(value)}", hint)
    return value


def as_tuple(value: object, kind: type[T] | tuple[type[T], ...], what: str, hint: str | None = None) -> tuple[T, ...]:
    """Return a tuple of instances of `kind`, from an iterable of instances or from a single instance."""
    if isinstance(value, kind):
        return (value,)
    if isinstance(value, str) or not hasattr(value, "__iter__"):
        as_one(value, kind, f"{what}: each", hint)
    values: Iterable[object] = value  # type: ignore[assignment]
    return tuple(as_one(each, kind, f"{what}[{i}]", hint) for i, each in enumerate(values))


def as_names(value: object, what: str) -> tuple[str, ...]:
    """Return a tuple of names, from an iterable of names or from a single name."""
    if not isinstance(value, Iterable):
        raise wrong(what, f"must be one or more names, got {shown(value)}")
    return as_tuple(value, str, what)


def as_choice(value: str, choices: Collection[str], what: str) -> str:
    """Return the value. Raises InputError unless it is one of the choices."""
    if value not in choices:
        raise wrong(what, f"must be one of {', '.join(choices)}; got {shown(value)}", did_you_mean(value, choices).rstrip() or None)
    return value


def assigned(words: Iterable[str], argument: str, reserved: Mapping[str, str] = {}) -> dict[str, bool | int | float | str]:
    """Return the values of texts NAME=VALUE by name: numbers, True, False, or text. Raise InputError for a name with two values.
    argument: of the words, for messages; reserved: names that are refused -> the option to use instead."""
    values: dict[str, bool | int | float | str] = {}
    for word in words:
        name, sign, text = word.partition("=")
        if not (name and sign):
            raise InputError(f"{word!r} is not NAME=VALUE", argument=argument)
        if name in reserved:
            raise InputError("cannot be used with this command", argument=f"{argument} {name}",
                             hint=f"{reserved[name]} decides on the value")
        value = as_literal(text)
        if name in values and values[name] != value:
            raise InputError(f"has two values, {values[name]!r} and {value!r}", argument=f"{argument} {name}", hint="give one")
        values[name] = value
    return values


def as_literal(text: str) -> bool | int | float | str:
    """Return the number, True or False that a text is, otherwise the text."""
    for kind in ({"True": True, "False": False}.__getitem__, int, float):
        with suppress(KeyError, ValueError):
            return kind(text)
    return text


def require_known(name: str, known: Collection[str], what: str, argument: str | None = None) -> None:
    """Raise InputError if `name` is not in `known`. what: noun for the named thing in the message, such as "camera"."""
    if name not in known:
        raise InputError(f"no {what} {shown(name)}", argument=argument,
                         hint=f"{did_you_mean(name, known)}there is {', '.join(known) or 'none'}")


def unknown(name: str, what: str, known: Iterable[str], *, argument: str | None = None, place: str | None = None) -> InputError:
    """Return the error about an unknown name. Its hint has the most similar known name, and the first 100 known names."""
    names = [str(each) for each in known]
    hint = f"{did_you_mean(name, names)}known are {listed(names, 100)}" if names else "there are none"
    return InputError(f"unknown {what} {short(name)}", argument=argument, place=place, hint=hint)


def listed(names: Collection[str], most: int = 5) -> str:
    """Return the first `most` names, each cut to 60 characters, and the number of further names."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(short, islice(names, most))) + more


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return "did you mean ...? " with the known name that is most similar; "" if none is."""
    near = most_similar(name, known) if isinstance(name, str) else ""
    return f"did you mean {near!r}? " if near else ""


def most_similar(name: str, known: Iterable[str]) -> str:
    """Return the known name that is most similar to `name`; "" if none is similar."""
    names = [each for each in islice(known, 1000) if len(each) <= 100]
    return next(iter(difflib.get_close_matches(name[:100], names, n=1)), "")


def at_thing(kind: str, name: str) -> str:
    """Return the beginning of a message about an object of a scene, such as "camera 'main': "; without the name if that is ""."""
    return f"{kind} {name!r}: " if name else f"{kind}: "


def shown(value: object) -> str:
    """Return a value for a message: numbers, text and lists as they are, but short; arrays by shape and type, other objects by their class,
    with the package of a class that is not wrt's own."""
    if isinstance(value, str | int | float | tuple | list) or value is None:
        return short(value)
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    package = type(value).__module__.partition(".")[0]
    return _a(("" if package in ("builtins", "wrt") else f"{package}.") + type(value).__name__)


def short(value: object, most: int = 60) -> str:
    """Return repr(value), cut to `most` characters; the type if repr fails."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, tables nested thousands deep
        return f"{_a(type(value).__name__)} too long to show"
    return text if len(text) <= most else text[:most - 3] + "..."


def _a(name: str) -> str:
    return f"{'an' if name[:1] in 'AEIOaeio' else 'a'} {name}"


def accepts(kind: object, value: object) -> bool:
    """Return True if a value fits an annotation: a class, or a union of classes. Other annotations accept any value.

    An int also fits float; a bool fits neither int nor float."""
    if get_origin(kind) in (Union, UnionType):
        return any(accepts(each, value) for each in get_args(kind))
    if not isinstance(kind, type):
        return True
    return isinstance(value, (int, float) if kind is float else kind) and (kind is bool or not isinstance(value, bool))
