"""Ray classes of other libraries, implemented with wrt's queries: a program changes only its import. wrt itself does not use them."""

from __future__ import annotations

import importlib
from types import ModuleType

_MODULES = ("mujoco", "newton", "open3d", "pyvista", "trimesh")


def __getattr__(name: str) -> ModuleType:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
