"""Table of names whose entries are imported on first use, so that a program imports only the modules that it uses."""

import importlib
from collections import UserDict
from collections.abc import ItemsView, Iterator, Mapping, ValuesView
from typing import Any, TypeVar

from wrt.core.errors import InputError, warn

T = TypeVar("T")


class Registry(UserDict[str, T]):
    """Map a name to an entry, or to "module:attribute", which the first lookup imports.

    kind: word for an entry in messages. group: group of entry points by which installed packages add entries ("": none). Entry points
    are read when a name is unknown or all names are needed, and replace no entry of the table. base: class of the entries. A lookup of
    an entry point that is broken raises InputError; `items` and `values` leave it out with a warning."""

    def __init__(self, kind: str, places: Mapping[str, T | str], group: str = "", base: type[Any] = object) -> None:
        super().__init__(places)  # type: ignore[arg-type]
        self.kind, self.group, self.base = kind, group, base
        self.added: dict[str, str] = {}  # what each entry point is, for messages

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise KeyError(name)
        thing: Any = self.data[name]
        if isinstance(thing, str):
            try:
                module, attribute = thing.split(":")
                thing = getattr(importlib.import_module(module), attribute)
                if not isinstance(thing, self.base):
                    raise TypeError(f"it is of the type {type(thing).__name__}, not {self.base.__name__}")
            except (Exception, SystemExit) as error:
                if name not in self.added:
                    raise
                why = " ".join(f"{type(error).__name__}: {error}".split())
                raise InputError(f"{self.kind} {name!r} cannot be used: {self.added[name]} is broken ({why})") from error
            self.data[name] = thing
        return thing

    def __contains__(self, name: object) -> bool:
        return name in self.data or name in self._all()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.kind}: {', '.join(self)})"

    def items(self) -> ItemsView[str, T]:
        entries: dict[str, T] = {}
        for name in self:
            try:
                entries[name] = self[name]
            except InputError as error:
                if name not in self.added:
                    raise
                warn(str(error))
        return entries.items()

    def values(self) -> ValuesView[T]:
        return dict(self.items()).values()

    def check(self, name: str, argument: str | None = None) -> None:
        """Raise InputError if the table has no such name."""
        from wrt.core.checks import require_known  # imports NumPy, which would delay the help of commands

        require_known(name, self, self.kind, argument)

    def _all(self) -> dict[str, Any]:
        """Return all entries, with those of installed packages."""
        if self.group:
            from importlib.metadata import entry_points

            for each in entry_points(group=self.group):
                if each.name not in self.data:
                    self.added[each.name] = f"the entry point {each.value} ({self.group}) of {_package(each)}"
                    self.data[each.name] = each.value  # type: ignore[assignment]
            self.group = ""
        return self.data


def _package(entry: Any) -> str:
    try:
        return f"the package {entry.dist.name}"
    except Exception:  # as its metadata can be, which the finder of importlib_metadata refuses
        return "a package without a name"
