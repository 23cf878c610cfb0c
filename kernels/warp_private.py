"""What device code knows of Warp's insides.
The rest is in wrt/core/warp_private.py, which only host code may import; see docs/warp.md, "When Warp changes"."""

from typing import Any


def fields_of(struct: Any) -> dict[str, Any]:
    """Return the fields of a Warp struct, or of an instance of one: their Warp types by name, in order."""
    return {name: variable.type for name, variable in getattr(struct, "_cls", struct).vars.items()}
