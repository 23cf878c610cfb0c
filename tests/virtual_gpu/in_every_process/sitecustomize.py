"""Install virtual GPUs in the processes that tests start: Python runs this file at start, as its folder is in PYTHONPATH.

It waits until the process imports Warp, because some tests check that a process does not import Warp.
"""

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from typing import Any


class BeforeWarp(MetaPathFinder):
    """An import hook that installs virtual GPUs after the import of Warp."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name != "warp":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)
        assert spec is not None and spec.loader is not None
        execute = spec.loader.exec_module

        def then_install(module: Any) -> None:
            execute(module)
            if "tests.virtual_gpu" not in sys.modules:  # a worker of pytest installs them itself
                from tests.virtual_gpu import install

                install()

        spec.loader.exec_module = then_install  # type: ignore[method-assign]
        return spec


sys.meta_path.insert(0, BeforeWarp())
