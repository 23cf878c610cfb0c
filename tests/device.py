"""The device that tests run on: the CPU, or the device that `pytest --device` names."""

from __future__ import annotations

import os
import sys
from pathlib import Path

NAME = "cpu"
IS_VIRTUAL = False


def use(name: str, *, real: bool = False, seed: int = 0) -> None:
    """Make `name` the default device of all functions and commands; call before the first import of wrt.

    real: use a GPU of this machine instead of a virtual GPU (tests/virtual_gpu), whose threads run in an order drawn by `seed`."""
    global NAME, IS_VIRTUAL
    assert "wrt.core.settings" not in sys.modules
    os.environ["WRT_DEVICE"] = name  # for processes that tests start, too
    if not real:
        from tests.virtual_gpu import install

        install(seed=seed)
        here = Path(__file__).parent  # so that processes which tests start have the virtual GPU, too
        paths = [str(here / "virtual_gpu" / "in_every_process"), str(here.parent), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    from wrt.core.device import start

    start(name)
    NAME, IS_VIRTUAL = name, not real
