"""Errors about unknown names of attributes and arguments, with the name that means the same or is most similar."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import fields
from functools import wraps
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from wrt.core.checks import did_you_mean

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


class Suggests:
    """A dataclass that answers an unknown attribute with the public one that means the same or is most similar."""

    if not TYPE_CHECKING:  # type checkers report unknown names themselves

        def __getattr__(self, name: str) -> NoReturn:
            raise no_attribute(self, name, dir(type(self)) + [each.name for each in fields(self)])


def no_attribute(thing: object, name: str, known: Iterable[str]) -> AttributeError:
    """Return the error about an unknown attribute, with the public one that means the same or is most similar."""
    near = other_name(name, [each for each in known if not each.startswith("_")]) if not name.startswith("_") else ""
    return AttributeError(f"{type(thing).__name__} has no attribute {name!r}{near}")


def check_keywords(function: str, keywords: Iterable[str], known: Collection[str]) -> None:
    """Raise TypeError for a keyword that a function does not know, with the known one that means the same or is most similar."""
    for name in keywords:
        if name not in known:
            raise TypeError(f"{function}() got an unexpected keyword argument {name!r}{other_name(name, known)}")


def parameters_of(function: Callable[..., object], *more: str) -> list[str]:
    """Return the names of the keywords of a function: its parameters, with `more` in place of `**`."""
    return [*more, *(name for name, each in signature(function).parameters.items() if each.kind is not Parameter.VAR_KEYWORD)]


def other_name(name: str, known: Collection[str]) -> str:
    """Return "; did you mean ...?" with the known name that means the same as `name` or is most similar; "" without either."""
    near = did_you_mean(name, known)
    return near and f"; {near.rstrip()}"


def suggest_fields(cls: type[T]) -> type[T]:
    """Let a dataclass answer an unknown keyword with the field that means the same or is most similar."""
    known, init = [each.name for each in fields(cls)], cls.__init__  # type: ignore[arg-type]

    @wraps(init)
    def __init__(self: T, *args: Any, **keywords: Any) -> None:
        check_keywords(cls.__name__, keywords, known)
        init(self, *args, **keywords)

    cls.__init__ = __init__  # type: ignore[method-assign, assignment]
    return cls


def suggest_keywords(function: F) -> F:
    """Let a function, or a class method that passes its other keywords to a dataclass, answer an unknown keyword as suggest_fields does."""
    form, own = signature(function), parameters_of(function)

    @wraps(function)
    def with_suggestions(*args: Any, **keywords: Any) -> Any:
        cls = args[0] if own[0] == "cls" else None
        name, known = function.__name__, own
        if cls:
            name, known = f"{cls.__name__}.{name}", [*own[1:], *(each.name for each in fields(cls))]
        check_keywords(name, keywords, known)
        try:
            form.bind(*args, **keywords)
        except TypeError as error:
            raise TypeError(f"{name}(): {error}") from None
        return function(*args, **keywords)

    return with_suggestions  # type: ignore[return-value]
