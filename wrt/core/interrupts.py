"""Ctrl-C as a question that work asks between its pieces, not as an exception in the middle of one; on the command line
SIGTERM and SIGHUP count as Ctrl-C too, so that a batch system's or a closed terminal's end keeps the picture so far."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt that knows its signal's number."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _raise(number: int, frame: Any) -> NoReturn:
    raise Interrupted(number)


# The signals that end a render early, and the handler of each that says so: another handler is somebody else's, and stays.
HANDLERS: dict[int, Callable[..., Any]] = {signal.SIGINT: signal.default_int_handler} | {
    getattr(signal, name): _raise for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)}


def raise_on_termination() -> None:
    """Let SIGTERM and SIGHUP raise Interrupted where they would end the process (nohup's ignored SIGHUP stays ignored)."""
    for number, handler in HANDLERS.items():
        if signal.getsignal(number) is signal.SIG_DFL and handler is _raise:
            signal.signal(number, handler)


def exit_code(number: int | None) -> int:
    """What a shell expects of a process that this signal ended (None: Ctrl-C): 128 and its number."""
    return 128 + int(signal.SIGINT if number is None else number)


@contextmanager
def held_interrupts() -> Iterator[list[int]]:
    """Hold Ctrl-C back during the block; the list that it yields is empty until one comes, and then has the numbers.

    SIGTERM and SIGHUP are held too after raise_on_termination. Where a signal raises no KeyboardInterrupt in this thread (in
    another than the main one, or where somebody else handles or ignores it), nothing changes for it.
    """
    came: list[int] = []
    held = []
    if threading.current_thread() is threading.main_thread():
        held = [number for number, handler in HANDLERS.items() if signal.getsignal(number) is handler]
    for number in held:
        signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield came
    finally:
        for number in held:
            signal.signal(number, HANDLERS[number])
