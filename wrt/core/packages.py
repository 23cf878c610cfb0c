"""Optional packages: imported when they are needed. The message about a missing package says how to install it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from wrt.core.errors import InputError

# Names of packages that differ from the names of their modules.
INSTALLED_AS = {"OpenImageIO": "openimageio", "PIL": "pillow", "elftools": "pyelftools"}


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """Turn a missing module, imported in the block, into an InputError that says what needs it and how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).split(".")[0]
        raise InputError(f"{what} needs {package}", hint=f"pip install {INSTALLED_AS.get(package, package)}") from error
