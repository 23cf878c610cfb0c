"""What all tests start from."""

import signal


def pytest_configure() -> None:
    """Ctrl-C means what it means at a terminal: a shell that runs tests in the background has it ignored, by their children too."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
