"""Mesh formats: each module of this folder has the name of a suffix, and its function `read` reads such files.

The command line's help lists the suffixes. This file must not import NumPy, which would delay the help.
"""

from pkgutil import iter_modules

PLACES = {f".{module.name}": f"{__name__}.{module.name}:read" for module in iter_modules(__path__)}
SUFFIXES = ", ".join(PLACES)
