"""A table of names whose entries are imported when they are first asked for: a program pays for the structure that it takes."""

from __future__ import annotations

import importlib
from collections import UserDict
from collections.abc import Iterator
from typing import Any, TypeVar

T = TypeVar("T")


class Registry(UserDict[str, T]):
    """Name -> thing. A row is the thing, or "module:thing", which a lookup imports.

    kind: what the things are, for messages; group: the entry points under which installed packages declare further rows ("": none).
    They are looked for when a name is not in the table or all names are wanted, and never take the place of a row.
    """

    def __init__(self, kind: str, places: dict[str, Any], group: str = "") -> None:
        super().__init__(places)
        self.kind, self.group = kind, group

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise KeyError(name)
        thing: Any = self.data[name]
        if isinstance(thing, str):
            module, attribute = thing.split(":")
            thing = getattr(importlib.import_module(module), attribute)
            self[name] = thing
        return thing

    def __contains__(self, name: object) -> bool:
        return name in self.data or name in self._all()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kind}: {', '.join(self)})"

    def check(self, name: str) -> None:
        """Raise InputError where there is nothing of that name."""
        from wrt.core.checks import require_known  # imports NumPy, for which the help of commands does not wait

        require_known(name, self, self.kind)

    def _all(self) -> dict[str, Any]:
        """Return the rows with those of installed packages."""
        if self.group:
            from importlib.metadata import entry_points

            for each in entry_points(group=self.group):
                self.data.setdefault(each.name, each.value)  # type: ignore[arg-type]
            self.group = ""
        return self.data
