"""How much memory a piece of work takes at its peak."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")


def peak_bytes(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` gives, and by how many bytes the process grew at its peak, whoever asked for them (Linux; else NaN).

    What the process had freed and kept would be used without growing: it is given back first, as far as the system can.
    """
    gc.collect()
    with suppress(AttributeError, OSError, TypeError):  # no such library, or (Windows) none without a name
        ctypes.CDLL(None).malloc_trim(0)
    before = status("VmRSS") if reset_peak() else float("nan")
    result = work()
    return result, max(status("VmHWM") - before, 0.0)


def reset_peak() -> bool:
    """Let the peak (VmHWM) be what is used now; whether the system could."""
    try:
        with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
            file.write("5")
    except OSError:
        return False
    return True


def status(name: str) -> float:
    """A size in /proc/self/status, in bytes; NaN where there is none."""
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            for line in file:
                if line.startswith(name + ":"):
                    return 1024.0 * float(line.split()[1])
    except OSError:
        pass
    return float("nan")
