"""How much memory can still be had, and the refusal of work that would take more.

What is free is the smallest of what the system calls available, what the control groups of this process leave it, and its own
limit of address space. The environment variable WRT_MEMORY ("24G", or bytes) is taken in its place, for more or for less: it is
what this process may take in all, so that free is what of it has not been taken yet.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

from wrt.core.errors import InputError

SMALL = 1 << 26  # bytes that nobody asks about: looking takes longer than they are worth
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# Of each version of control groups: where its tree is, and the files that tell limit and use in a folder of it.
_GROUPS = {"": (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
           "memory": (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")}


def available() -> float:
    """Bytes of main memory that this process can still take; infinite where the system does not tell. What has been taken of
    WRT_MEMORY is what is resident beyond what was when wrt was imported; 0 where the system does not tell that. Raises InputError
    for a WRT_MEMORY that is no size."""
    if text := os.environ.get("WRT_MEMORY"):
        match = re.fullmatch(r"\s*([0-9]{1,15}(?:\.[0-9]*)?)\s*([KMGT]?)(?:i?B)?\s*", text, re.IGNORECASE)
        if match is None:
            raise InputError(f"must be a number of bytes such as 24G, got {text!r}", None, "WRT_MEMORY")
        return max(0.0, float(match[1]) * UNITS[match[2].upper()] - max(0.0, resident() - _AT_START))
    return min(_of_system(), _of_groups(), address_space())


def require(needed: float, what: str) -> None:
    """Raise InputError, which tells both numbers, where `what` takes more bytes than are available."""
    if needed > SMALL and needed > (there := available()):
        raise InputError(f"{what} takes {gib(needed)} of memory; {gib(there)} are free (WRT_MEMORY can say otherwise)")


class Meter:
    """Asks for memory that is taken in many small pieces, whenever they come to a large one."""

    def __init__(self) -> None:
        self._taken = 0.0

    def take(self, size: float, what: str) -> None:
        """Raise InputError where what was taken since the last look, with these `size` bytes of `what`, is more than there is."""
        self._taken += size
        if self._taken > SMALL:
            require(self._taken, what)
            self._taken = 0.0


def resident() -> float:
    """Bytes of main memory that this process has now; 0 where the system does not tell."""
    try:
        return float(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError, IndexError):
        return 0.0


_AT_START = resident()


def gib(size: float) -> str:
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 / 10 else f"{size / 2**20:.0f} MiB"


def _of_system() -> float:
    with contextlib.suppress(OSError):
        if match := re.search(r"^MemAvailable:\s*(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE):
            return 1024.0 * int(match[1])
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return float("inf")


def _of_groups() -> float:
    """What the limits of this process's control groups, and of those that hold them, leave; a file cache can be given back."""
    left = float("inf")
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, name = line.split(":", 2)
            for controller in {"memory"} & set(controllers.split(",")) or {""} & {controllers}:
                root, limit, use, cache = _GROUPS[controller]
                folder = root / name.lstrip("/")
                for each in (folder, *folder.parents):
                    if each.is_relative_to(root):
                        left = min(left, _of_group(each, limit, use, cache))
    return left


def _of_group(folder: Path, limit: str, use: str, cache: str) -> float:
    try:
        most = (folder / limit).read_text().strip()
        used = int((folder / use).read_text())
        match = re.search(rf"^{cache} (\d+)", (folder / "memory.stat").read_text(), re.MULTILINE)
    except (OSError, ValueError):
        return float("inf")
    return float("inf") if most == "max" else max(0.0, float(most) - used + (int(match[1]) if match else 0))


def address_space() -> float:
    """Bytes of address space that this process can still take; infinite where it is not limited."""
    try:
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most == resource.RLIM_INFINITY:
            return float("inf")
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        return float("inf")
    return max(0.0, float(most) - used)
