"""Recorded launches for kernels that launch others (wrt.kernels.launches)."""

from __future__ import annotations

import ctypes
from typing import Any

from wrt.kernels.launches import Launch


class Launches:
    """Keeps what their addresses stand for."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def recorded(self, command: Any, block: int = 1) -> Any:
        """A record for the device. command: of wp.launch(..., device="cpu", record_cmd=True); block: as Launch's."""
        size, *params = command.params  # as Warp hands them to the kernel
        fields = [(f"arg_{i}", type(param)) for i, param in enumerate(params)]
        args = type("Args", (ctypes.Structure,), {"_fields_": fields})(*params)
        self.kept += [command, args]
        record = Launch()
        record.entry = ctypes.cast(command.hooks.forward, ctypes.c_void_p).value
        record.bounds, record.args = ctypes.addressof(size), ctypes.addressof(args)
        record.tail = record.args + getattr(type(args), fields[-1][0]).offset
        record.block = block
        return record
