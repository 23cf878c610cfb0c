"""The device that tests run on: the CPU, or the device that `pytest --device` names."""

from __future__ import annotations

import gc
import importlib
import os
from pathlib import Path
from types import FunctionType
from typing import Any

NAME = "cpu"
IS_VIRTUAL = False
# Modules with functions whose default device is "cpu".
MODULES = ("wrt.accel.base", "wrt.accel.scenes.build", "wrt.accel.instances", "wrt.accel.store", "wrt.compat.open3d",
           "wrt.compat.trimesh", "wrt.renderer.compile", "wrt.renderer.options", "wrt.lab.bench.rasterizer", "wrt.lab.plans")


def use(name: str, *, real: bool = False, seed: int = 0) -> None:
    """Make `name` the default device of all functions and commands; call before Warp starts.

    real: use a GPU of this machine instead of a virtual GPU (tests/virtual_gpu), whose threads run in an order drawn by `seed`."""
    global NAME, IS_VIRTUAL
    if not real:
        from tests.virtual_gpu import install

        install(seed=seed)
        here = Path(__file__).parent  # so that processes which tests start have the virtual GPU, too
        paths = [str(here / "virtual_gpu" / "in_every_process"), str(here.parent), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    from wrt.core.device import start

    start(name)
    NAME, IS_VIRTUAL = name, not real
    for module in MODULES:
        importlib.import_module(module)
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and function.__module__ in MODULES:
            _set_default(function, name)
    from wrt.cli.main import cli

    _set_option(cli, name)


def _set_default(function: FunctionType, name: str) -> None:
    code, values = function.__code__, function.__defaults__ or ()
    names = code.co_varnames[code.co_argcount - len(values) : code.co_argcount]
    function.__defaults__ = tuple(name if (each, value) == ("device", "cpu") else value
                                  for each, value in zip(names, values, strict=True)) or None
    if (function.__kwdefaults__ or {}).get("device") == "cpu":
        function.__kwdefaults__["device"] = name


def _set_option(command: Any, name: str) -> None:
    """Set the default of --device of a command and its subcommands."""
    for each in getattr(command, "commands", {}).values():
        _set_option(each, name)
    for parameter in command.params:
        if (parameter.name, parameter.default) == ("device", "cpu"):
            parameter.default = name
