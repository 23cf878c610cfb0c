"""Ctrl-C as a question that work asks between its pieces, not as an exception in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def held_interrupts() -> Iterator[list[int]]:
    """Hold Ctrl-C back during the block; the list that it yields is empty until one comes.

    Where Ctrl-C raises no KeyboardInterrupt in this thread (in another than the main one, or where somebody else handles
    or ignores the signal), nothing changes and the list stays empty.
    """
    came: list[int] = []
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield came
        return
    signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
