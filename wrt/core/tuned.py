"""What `wrt.tune` found best on a device: kept in a small file in the user's cache folder, and read from there.

A choice is about speed alone: hits and pixels have the same bits whatever it is. It holds for one kind of device and one version of
wrt and of Warp; for others it is not looked at.
"""

from __future__ import annotations

import json
import operator
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from wrt.core.errors import InputError
from wrt.core.files import read_file
from wrt.core.version import VERSION
from wrt.core.write_file import check_writable, replacing

# What there is to choose from.
STRUCTURES = ("bvh8", "bvh2", "bvh4", "bvh8c")
BLOCK_DIMS = (64, 32, 128, 256)
STACKS = ("shared", "local")  # kernels.traverse.stack.PLACES


@dataclass(frozen=True)
class Choice:
    """accel: the structure that "bvh" means; block_dim: threads of a block of a CUDA launch; stack: where bvh2 and the wide BVHs
    have the first entries of theirs on CUDA. Why these are the default: docs/acceleration.md, "Structure and blocks on a GPU"."""

    accel: str = STRUCTURES[0]
    block_dim: int = BLOCK_DIMS[0]
    stack: str = STACKS[0]


DEFAULT = Choice()
_in_place_of: dict[str, Choice] = {}


def choice_for(device: Any) -> Choice:
    """For a device of Warp's: what is kept for it, or the default."""
    return _in_place_of.get(device.alias) or kept(device) or DEFAULT


def kept(device: Any) -> Choice | None:
    """What `wrt.tune` has kept for such a device. A file that does not hold it is told of in one warning, and is not used."""
    return _read(cache_folder(), *_described(device))


def place_for(device: Any) -> Path:
    """The file for such devices. Raises InputError where it cannot be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made: {error.strerror} (WRT_CACHE_PATH names another folder)", folder) from error
    path = _file(folder, _described(device))
    check_writable(path)
    return path


def keep(device: Any, choice: Choice) -> Path:
    """Write the choice for such devices. Returns the file; raises InputError where the system refuses."""
    path = place_for(device)
    with replacing(path) as new:
        new.write_text(json.dumps(_content(_described(device), choice), indent=1) + "\n", encoding="utf-8")
    _read.cache_clear()
    return path


@contextmanager
def using(device: Any, choice: Choice) -> Iterator[None]:
    """In the block, for all threads, this choice and not the one that is kept."""
    before = _in_place_of.get(device.alias)
    _in_place_of[device.alias] = choice
    try:
        yield
    finally:
        del _in_place_of[device.alias]
        if before is not None:
            _in_place_of[device.alias] = before


def cache_folder() -> Path:
    """WRT_CACHE_PATH, or the folder of wrt where the system's users have their caches."""
    if given := os.environ.get("WRT_CACHE_PATH"):
        return Path(given)
    home = Path(os.path.expanduser("~"))
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "wrt"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "wrt"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "wrt"


def _described(device: Any) -> tuple[str, str]:
    """The kind of device, and Warp's version."""
    import warp as wp

    name = device.name or "CPU"
    what = f"sm_{device.arch}" if device.is_cuda else f"{platform.machine()}, {os.cpu_count()} threads"
    return f"{name}, {what}", wp.__version__


def _file(folder: Path, described: tuple[str, str]) -> Path:
    return folder / f"tuned-{sha256(json.dumps([VERSION, *described]).encode()).hexdigest()[:16]}.json"


def _content(described: tuple[str, str], choice: Choice) -> dict[str, Any]:
    device, warp = described
    return {"wrt": VERSION, "warp": warp, "device": device, **asdict(choice)}


@cache
def _read(folder: Path, device: str, warp: str) -> Choice | None:
    described = device, warp
    path = _file(folder, described)
    if not os.path.exists(path):  # nor where it may not be looked for
        return None
    try:
        found = json.loads(read_file(path))
        choice = Choice(found["accel"], operator.index(found["block_dim"]), found["stack"])
        known = choice.accel in STRUCTURES and choice.block_dim in BLOCK_DIMS and choice.stack in STACKS
        if known and found == _content(described, choice):
            return choice
        reason = "is no choice for this device"
    except InputError as error:
        reason = str(error)
    except (ValueError, RecursionError, TypeError, KeyError):
        reason = "is damaged"
    warnings.warn(f"{path}: {reason}, and the default is used; `python -m wrt devices --tune --device NAME` writes it anew",
                  stacklevel=2)
    return None
