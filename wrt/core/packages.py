"""Packages that a part of wrt needs and queries do not: imported when they are used, and their absence is told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from wrt.core.errors import InputError

# Where the name that is installed is not the one that is imported.
INSTALLED_AS = {"OpenImageIO": "openimageio", "PIL": "pillow", "elftools": "pyelftools"}


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """Around imports: raise InputError that says what a package is needed for, and how to get it, where it is not there."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).split(".")[0]
        raise InputError(f"{what} needs {package}: pip install {INSTALLED_AS.get(package, package)}") from error
