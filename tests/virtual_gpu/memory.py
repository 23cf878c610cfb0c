"""The memory of virtual GPUs: host code cannot access it, and no address is used twice.

Every allocation has its own pages, and ends (up to alignment) at the end of its last page. The page behind it and freed pages are
never accessible; the others only while the device works (`opened`). So host code that reads device memory ends in a segmentation
fault, and so does a kernel that reads freed memory or beyond an array.
"""

from __future__ import annotations

import ctypes
import mmap
import threading
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager

SPACE = 1 << 42  # bytes of address space; pages cost nothing until they are used
ALIGNMENT = 256  # bytes, as of cudaMalloc
UNWRITTEN = 0xA5  # value of the bytes of new memory
FIXED = 0x10  # MAP_FIXED, on Linux and macOS
CLOSED, OPEN = 0, mmap.PROT_READ | mmap.PROT_WRITE

libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]


def whole(size: int, unit: int) -> int:
    """Return `size` rounded up to a multiple of `unit`."""
    return -(-size // unit) * unit


def reserve(place: int | None, size: int, more: int) -> int:
    """Reserve address space without access. Freed memory is reserved again, so that the system merges its pages with their
    neighbours: the number of separate mappings of a process is limited, to some 65,000 on Linux."""
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0) | more
    found = libc.mmap(place, size, CLOSED, flags, -1, 0)
    if found in (None, ctypes.c_void_p(-1).value):
        raise MemoryError(f"a virtual GPU needs {SPACE >> 40} TiB of address space: raise the limit (ulimit -v)")
    return int(found)


class Memory:
    """The memory of all devices. limit: bytes of each device."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.begin = self.next = reserve(None, SPACE, 0)
        self.starts: list[int] = []  # of live allocations, ascending because addresses only grow
        self.known: dict[int, tuple[int, int]] = {}  # by start: bytes, and the device's number
        self.working, self.lock = 0, threading.RLock()

    def allocate(self, size: int, device: int) -> int:
        """Return the address of `size` new bytes, 0 if the device has too little memory."""
        size = max(size, 1)
        room = whole(size, mmap.PAGESIZE)
        with self.lock:
            if self.used(device) + size > self.limit or self.next + room > self.begin + SPACE:
                return 0
            start = self.next + room - whole(size, ALIGNMENT)
            self.next += room + mmap.PAGESIZE
            self.starts.append(start)
            self.known[start] = size, device
            with self.opened():
                self._protect(start, size, OPEN)
                ctypes.memset(start, UNWRITTEN, size)
        return start

    def free(self, start: int) -> None:
        with self.lock:
            if start not in self.known:
                raise RuntimeError(f"{start:#x} is freed, and is {self.describe(start)}")
            size, _ = self.known.pop(start)
            self.starts.remove(start)
            first = start // mmap.PAGESIZE * mmap.PAGESIZE
            reserve(first, whole(start + size - first, mmap.PAGESIZE), FIXED)

    def used(self, device: int) -> int:
        """Return the number of allocated bytes of a device."""
        return sum(size for size, owner in self.known.values() if owner == device)

    def is_device(self, address: int) -> bool:
        """Return whether the address is, or was, on a device."""
        return self.begin <= address < self.begin + SPACE

    def holds(self, address: int, size: int, device: int) -> bool:
        """Return whether the bytes are within one live allocation of the device."""
        with self.lock:
            i = bisect_right(self.starts, address) - 1
            if i < 0:
                return False
            start = self.starts[i]
            room, owner = self.known[start]
            return address + size <= start + room and owner == device

    def describe(self, address: int) -> str:
        """Return words for error messages on where an address is."""
        if not self.is_device(address):
            return "memory of the host" if address else "no address"
        with self.lock:
            i = bisect_right(self.starts, address) - 1
            if i >= 0 and address <= self.starts[i] + self.known[self.starts[i]][0]:
                size, owner = self.known[self.starts[i]]
                return f"byte {address - self.starts[i]} of {size} on cuda:{owner}"
        return "device memory that was freed"

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Make all live allocations accessible during the block."""
        self._change(1)
        try:
            yield
        finally:
            self._change(-1)

    def _change(self, step: int) -> None:
        with self.lock:
            before, self.working = self.working > 0, self.working + step
            if before != (self.working > 0):
                for start, (size, _) in self.known.items():
                    self._protect(start, size, CLOSED if before else OPEN)

    @staticmethod
    def _protect(start: int, size: int, how: int) -> None:
        first = start // mmap.PAGESIZE * mmap.PAGESIZE
        if libc.mprotect(first, whole(start + size - first, mmap.PAGESIZE), how):
            raise MemoryError(f"mprotect: error {ctypes.get_errno()}")
