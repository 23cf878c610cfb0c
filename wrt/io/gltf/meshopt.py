"""Buffer views that meshoptimizer compressed (EXT_meshopt_compression, KHR_meshopt_compression), decoded by meshopt.

Source: the texts of both extensions. A file that does not require the extension has plain buffers, which wrt reads instead.
"""

from __future__ import annotations

import numpy as np

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.io.gltf.schema import MeshoptView

NAMES = ("KHR_meshopt_compression", "EXT_meshopt_compression")
_MOST = 1024  # bytes for which one byte of data can stand: four columns of a block of 256 vertices, if all are 0


def decode(data: np.ndarray, view: MeshoptView, length: int, place: str) -> np.ndarray:
    """Return the `length` bytes (N,) uint8 of a compressed buffer view; `data` are its compressed bytes.

    Raises InputError if meshopt is missing, or if the data are damaged or do not have this length."""
    if view.count < 1 or view.count * view.byteStride != length:
        raise InputError(f"{view.count} elements of {view.byteStride} bytes do not fill the {length} bytes of the buffer view", place=place)
    if length > _MOST * len(data):
        raise InputError(f"{len(data)} bytes of data are too few for {length}", place=place)
    with needed_by("a glTF file with meshopt compression"):
        import meshopt
    try:
        decoded = meshopt.decode_gltf_buffer(data.tobytes(), view.count, view.byteStride, view.mode, view.filter)
    except ValueError as error:
        raise InputError(f"is not data that meshoptimizer compressed ({error})", place=place) from error
    return decoded.reshape(-1).view(np.uint8)
