"""Recorded launches for kernels that launch others (wrt.kernels.launches)."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from wrt.kernels.launches import Launch


@cache
def args_of(*types: Any) -> Any:
    """What Warp hands a kernel of the CPU its arguments in; made once for each, since a class is a circle for the collector."""
    return type("Args", (ctypes.Structure,), {"_fields_": [(f"arg_{i}", each) for i, each in enumerate(types)]})


class Launches:
    """Keeps what their addresses stand for.

    This is what wrt relies on beyond Warp's documents (1.19; tests/kernels/test_launches.py holds it): a command's `params` are
    its bounds and arguments, and its code is a C function of the addresses of both.
    """

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def recorded(self, command: Any, block: int = 1) -> Any:
        """A record for the device. command: of wp.launch(..., device="cpu", record_cmd=True); block: as Launch's."""
        size, *params = command.params  # as Warp hands them to the kernel
        assert len(size.shape) == 1, "run_range sets bounds of one dimension"
        args = args_of(*map(type, params))(*params)
        self.kept += [command, args]
        record = Launch()
        record.entry = ctypes.cast(command.hooks.forward, ctypes.c_void_p).value
        record.bounds, record.args = ctypes.addressof(size), ctypes.addressof(args)
        record.tail = record.args + getattr(type(args), f"arg_{len(params) - 1}").offset
        record.block = block
        return record
