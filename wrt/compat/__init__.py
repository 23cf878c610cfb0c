"""Ray classes of other libraries with wrt's queries: change one import, keep the program. Nothing of wrt imports this."""

from __future__ import annotations

import importlib
from types import ModuleType

_MODULES = ("open3d", "trimesh")


def __getattr__(name: str) -> ModuleType:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
