"""A table of names whose entries are imported when they are first asked for: a program pays for the structure that it takes."""

from __future__ import annotations

import importlib
from typing import Any, TypeVar

from wrt.core.checks import require_known

T = TypeVar("T")


class Registry(dict[str, T]):
    """Name -> thing. Given as "module:thing"; whoever asks gets the thing itself. kind: what they are, for messages."""

    def __init__(self, kind: str, places: dict[str, str]) -> None:
        super().__init__()
        self.kind = kind
        for name, place in places.items():
            super().__setitem__(name, place)  # type: ignore[assignment]

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

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    def values(self) -> Any:
        self._import_all()
        return super().values()

    def items(self) -> Any:
        self._import_all()
        return super().items()

    def _import_all(self) -> None:
        for name in self:
            self[name]
