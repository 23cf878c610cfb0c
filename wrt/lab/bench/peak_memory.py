"""How much memory a piece of work takes at its peak."""

from __future__ import annotations

import ctypes
import gc
import math
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def peak_bytes(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` gives, and by how many bytes the process grew at its peak, whoever asked for them (Linux; else NaN).

    What the process had freed and kept would be used without growing: it is given back first, as far as the system can.
    """
    gc.collect()
    with suppress(AttributeError, OSError, TypeError):  # no such library, or (Windows) none without a name
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak is what is used now
    except OSError:
        return work(), math.nan
    before = _peak()
    return work(), max(_peak() - before, 0.0)


def _peak() -> float:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return 1024.0 * float(found[1]) if found else math.nan
