"""Options of pytest for the device that tests run on, and Ctrl-C in runs in the background."""

import signal

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("device")
    group.addoption("--device", default="cpu", help="default device: cpu, or cuda:0, a virtual GPU (tests/virtual_gpu)  [default: cpu]")
    group.addoption("--real-gpu", action="store_true", help="--device is one of this machine's GPUs, not a virtual one")
    group.addoption("--thread-seed", type=int, default=0, help="seed of the random order in which a virtual GPU runs threads")


def pytest_report_header(config: pytest.Config) -> list[str]:
    name, real = config.getoption("--device"), config.getoption("--real-gpu")
    return [] if name == "cpu" else [f"device: {name}, {'of this machine' if real else 'a virtual GPU'}"]


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--device") != "cpu":
        from tests import device

        device.use(config.getoption("--device"), real=config.getoption("--real-gpu"), seed=config.getoption("--thread-seed"))
    # A shell starts programs in the background with Ctrl-C ignored, and their children inherit that; tests of Ctrl-C need it.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
