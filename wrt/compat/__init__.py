"""Other libraries' ray classes, answered by wrt: change one import, keep the program. Nothing of wrt imports this."""

from __future__ import annotations

import importlib
from typing import Any

_MODULES = ("open3d", "trimesh")


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
