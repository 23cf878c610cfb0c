"""Mesh formats: a module of this folder reads one, by its function `read`, and has the name of the files' suffix.

The command line's help reads the table too, and must not wait for NumPy.
"""

from __future__ import annotations

from pkgutil import iter_modules

PLACES = {f".{module.name}": f"{__name__}.{module.name}:read" for module in iter_modules(__path__)}
SUFFIXES = ", ".join(PLACES)
