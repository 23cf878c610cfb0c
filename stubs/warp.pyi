"""Warp as the type checker is to see it: device code is not checked (its annotations are Warp's, not types), all else is Any."""

from collections.abc import Callable
from typing import Any
from typing import no_type_check as func
from typing import no_type_check as kernel

__all__ = ["func", "func_native", "kernel"]

def func_native(snippet: str) -> Callable[[Any], Any]: ...
def __getattr__(name: str) -> Any: ...
