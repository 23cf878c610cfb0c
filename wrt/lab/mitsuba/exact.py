"""What Mitsuba cannot draw exactly is refused: a comparison of other light says nothing."""

from __future__ import annotations

from typing import NoReturn

from wrt.core.errors import InputError


def refuse(what: str, where: str = "") -> NoReturn:
    raise InputError(f"not translatable exactly: {what}", None, f"Mitsuba: {where}" if where else "Mitsuba")
