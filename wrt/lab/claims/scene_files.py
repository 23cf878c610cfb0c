"""The caller's mesh files of published scenes."""

from collections.abc import Sequence

from wrt.core.checks import require_known
from wrt.core.errors import InputError

SCENES = ("bunny", "sponza", "conference")


def scene_files(pairs: Sequence[str]) -> dict[str, str]:
    """Return the mesh file of each scene from "name=file". Raise InputError for an unknown name, and without a file."""
    files = {}
    for pair in pairs:
        name, given, path = pair.partition("=")
        if not given or not path:
            raise InputError(f"{pair!r} names no file", argument="scene", hint=f"write {name or 'bunny'}=FILE")
        require_known(name, SCENES, "scene", "scene")
        files[name] = path
    return files
