"""What device code knows of Warp's insides. All else that wrt knows of them is in wrt/core/warp_private.py, which code of the host
alone may import; docs/warp.md, "When Warp changes"."""

from typing import Any


def fields_of(struct: Any) -> dict[str, Any]:
    """Return the fields of a Warp struct, or of an instance of one: their Warp types by name, in order."""
    return {name: variable.type for name, variable in getattr(struct, "_cls", struct).vars.items()}
