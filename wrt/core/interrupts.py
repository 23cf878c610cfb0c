"""Signals that end a render early: Ctrl-C takes effect between two tiles, in place of an exception in the middle of a tile.

On the command line SIGTERM and SIGHUP act like Ctrl-C, so that the picture so far survives the end of a batch job or a terminal."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt with the number of its signal."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def _raise(number: int, frame: object) -> NoReturn:
    raise Interrupted(number)


# The signals that end a render early, each with the handler that raises a KeyboardInterrupt. wrt replaces no handler of a user.
HANDLERS: dict[int, Callable[..., object]] = {signal.SIGINT: signal.default_int_handler} | {
    getattr(signal, name): _raise for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)}


def raise_on_termination() -> None:
    """Make SIGTERM and SIGHUP raise Interrupted if they would end the process. A SIGHUP that nohup ignores stays ignored."""
    for number, handler in HANDLERS.items():
        if signal.getsignal(number) is signal.SIG_DFL and handler is _raise:
            signal.signal(number, handler)


def exit_code(number: int | None) -> int:
    """Return the exit code that a shell reports for a process ended by a signal: 128 plus its number. None: Ctrl-C."""
    return 128 + int(signal.SIGINT if number is None else number)


@contextmanager
def held_interrupts() -> Iterator[list[int]]:
    """Hold Ctrl-C back during the block. Yield a list of the signal numbers that arrive; the caller reacts to them.

    After raise_on_termination, SIGTERM and SIGHUP are held back, too. Nothing is held back outside the main thread. Signals that the
    user handles or ignores are not held back."""
    arrived: list[int] = []
    held = []
    if threading.current_thread() is threading.main_thread():
        held = [number for number, handler in HANDLERS.items() if signal.getsignal(number) is handler]
    for number in held:
        signal.signal(number, lambda number, frame: arrived.append(number))
    try:
        yield arrived
    finally:
        for number in held:
            signal.signal(number, HANDLERS[number])
