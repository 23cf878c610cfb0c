"""A table of names whose entries are imported when they are first asked for: a program pays for the structure that it takes."""

from __future__ import annotations

import importlib
from collections import UserDict
from typing import Any, TypeVar

from wrt.core.checks import require_known

T = TypeVar("T")


class Registry(UserDict[str, T]):
    """Name -> thing. Given as "module:thing"; whoever asks gets the thing itself. kind: what they are, for messages."""

    def __init__(self, kind: str, places: dict[str, Any]) -> None:
        super().__init__(places)
        self.kind = kind

    def __getitem__(self, name: str) -> T:
        thing: Any = super().__getitem__(name)
        if isinstance(thing, str):
            module, attribute = thing.split(":")
            thing = getattr(importlib.import_module(module), attribute)
            self[name] = thing
        return thing

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kind}: {', '.join(self)})"

    def check(self, name: str) -> None:
        """Raise InputError where there is nothing of that name."""
        require_known(name, self, self.kind)
