"""Uses of undocumented parts of Warp in device code.
Host code has its own in wrt/core/warp_private.py; see docs/warp.md, "When Warp changes"."""

from typing import Any


def fields_of(struct: Any) -> dict[str, Any]:
    """Return the Warp types of the fields of a Warp struct (or of an instance of a struct) by name, in order."""
    return {name: variable.type for name, variable in getattr(struct, "_cls", struct).vars.items()}
