"""The memory of virtual GPUs: addresses that no host code may touch, and that are never given out twice.

Every allocation has pages of its own, and ends (but for alignment) where its last page ends. The page behind it, and the pages of
what was freed, stay closed for good; all others are open only while the device is at work (`opened`). So host code that reads the
device's memory, and a kernel that follows an old address or leaves an array, end in a segmentation fault.
"""

from __future__ import annotations

import ctypes
import mmap
import threading
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager

SPACE = 1 << 42  # bytes of address space; pages cost nothing until they are used
ALIGNMENT = 256  # as of cudaMalloc
UNWRITTEN = 0xA5  # what memory holds before anybody writes to it
FIXED = 0x10  # MAP_FIXED, on Linux and macOS
CLOSED, OPEN = 0, mmap.PROT_READ | mmap.PROT_WRITE

libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]


def whole(size: int, unit: int) -> int:
    """The next multiple."""
    return -(-size // unit) * unit


def reserve(place: int | None, size: int, more: int) -> int:
    """Address space without pages. Freed memory is reserved anew: only so do its pages melt into those beside them, of which the
    system lets a process have some ten thousand groups."""
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | getattr(mmap, "MAP_NORESERVE", 0) | more
    found = libc.mmap(place, size, CLOSED, flags, -1, 0)
    if found in (None, ctypes.c_void_p(-1).value):
        raise MemoryError(f"a virtual GPU takes {SPACE >> 40} TiB of address space (ulimit -v)")
    return int(found)


class Memory:
    """Of all devices together. limit: bytes that may be in use on each."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.begin = self.next = reserve(None, SPACE, 0)
        self.starts: list[int] = []  # ascending, as addresses only grow
        self.known: dict[int, tuple[int, int]] = {}  # by start: size, and the device's number
        self.working, self.lock = 0, threading.RLock()

    def allocate(self, size: int, device: int) -> int:
        """The address of so many new bytes; 0 where the device has no more."""
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
        """Bytes of a device that are not free."""
        return sum(size for size, owner in self.known.values() if owner == device)

    def is_device(self, address: int) -> bool:
        """Whether it is, or was, on a device."""
        return self.begin <= address < self.begin + SPACE

    def holds(self, address: int, size: int, device: int) -> bool:
        """Whether these bytes are in one live allocation of that device."""
        with self.lock:
            i = bisect_right(self.starts, address) - 1
            if i < 0:
                return False
            start = self.starts[i]
            room, owner = self.known[start]
            return address + size <= start + room and owner == device

    def describe(self, address: int) -> str:
        """What an address is."""
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
        """While the device is at work."""
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
