"""Table of names whose entries are imported on first use, so that a program imports only the modules that it uses."""

import importlib
from collections import UserDict
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

T = TypeVar("T")


class Registry(UserDict[str, T]):
    """Map a name to an entry, or to "module:attribute", which the first lookup imports.

    kind: word for an entry in messages. group: group of entry points by which installed packages add entries ("": none). Entry points
    are read when a name is unknown or all names are needed, and replace no entry of the table."""

    def __init__(self, kind: str, places: Mapping[str, T | str], group: str = "") -> None:
        super().__init__(places)  # type: ignore[arg-type]
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

    def check(self, name: str, argument: str | None = None) -> None:
        """Raise InputError if the table has no such name."""
        from wrt.core.checks import require_known  # imports NumPy, which would delay the help of commands

        require_known(name, self, self.kind, argument)

    def _all(self) -> dict[str, Any]:
        """Return all entries, with those of installed packages."""
        if self.group:
            from importlib.metadata import entry_points

            for each in entry_points(group=self.group):
                self.data.setdefault(each.name, each.value)  # type: ignore[arg-type]
            self.group = ""
        return self.data
