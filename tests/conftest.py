"""What all tests start from."""

import signal
from collections.abc import Callable

import pytest


def pytest_configure() -> None:
    """Ctrl-C means what it means at a terminal: a shell that runs tests in the background has it ignored, by their children too."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def say_memory(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets WRT_MEMORY; what the process of the tests has taken so far does not count."""
    from wrt.core import memory

    def say(text: str) -> None:
        monkeypatch.setenv("WRT_MEMORY", text)
        monkeypatch.setattr(memory, "resident", lambda: memory._AT_START)

    return say
