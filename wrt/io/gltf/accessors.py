"""glTF accessors as NumPy arrays: typed, strided, sparse and normalised.

Source: Khronos, glTF 2.0 specification, section 3.6.2 (accessors), and KHR_mesh_quantization for integer positions.
"""

from typing import Any

import numpy as np

from wrt.core.checks import short
from wrt.core.errors import InputError, at
from wrt.io.gltf.document import Document

_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_COUNT = 2**31 - 1
_MAX_IMPLICIT_COUNT = 2**22  # elements without a buffer, which are zeros: a file of a few bytes must not fill the memory


class Accessors:
    """Reader of a document's accessors. Each accessor is decoded once, into a read-only array that all callers share."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._arrays: dict[int, np.ndarray] = {}

    def read(self, index: int, kind: str, place: str, finite: bool = True) -> np.ndarray:
        """Return accessor `index` as an array (count, components of `kind`): float32 for floats and normalised integers, else integers.

        kind: "SCALAR", "VEC2", "VEC3", "VEC4" or "MAT4". Raises InputError at `place` if the accessor has another kind, does not fit into
        its buffer view, or, if `finite`, holds a float that is not finite."""
        accessor = self._document.item("accessors", index, place)
        if accessor.type != kind:
            raise InputError(f"must be of type {kind}, but accessors[{index}] is {short(accessor.type)}", place=place)
        if index not in self._arrays:
            with at(place):
                self._arrays[index] = self._decode(accessor, f"accessors[{index}]")
        if finite:
            with at(place):
                require_finite(self._arrays[index], f"accessors[{index}]")
        return self._arrays[index]

    def put(self, index: int, values: np.ndarray, place: str) -> None:
        """Set the array of accessor `index`, (count, components), which a compressed mesh holds. Raises InputError if it does not fit."""
        accessor = self._document.item("accessors", index, place)
        shape = accessor.count, _WIDTHS.get(accessor.type)
        if values.shape != shape:
            raise InputError(f"decodes to {values.shape} numbers, but accessors[{index}] has {shape}", place=place)
        array = _normalised(values, f"accessors[{index}]") if accessor.normalized else values.copy()
        array.flags.writeable = False
        self._arrays[index] = array

    def _decode(self, accessor: Any, where: str) -> np.ndarray:
        dtype, count = _dtype(accessor.componentType, where), accessor.count
        most = _MAX_COUNT if accessor.bufferView is not None else _MAX_IMPLICIT_COUNT
        if not 1 <= count <= most:
            raise InputError(f"must be 1 to {most}, got {count}", place=f"{where}.count")
        width = _WIDTHS[accessor.type]
        if accessor.bufferView is not None:
            array = self._elements(accessor.bufferView, accessor.byteOffset, dtype, (count, width), where)
        else:  # zeros, by the specification
            array = np.zeros((count, width), dtype)
        if accessor.sparse is not None:
            array = self._with_sparse(array, accessor.sparse, f"{where}.sparse")
        if accessor.normalized:
            array = _normalised(array, where)
        array.flags.writeable = False
        return array

    def _elements(self, view: int, offset: int, dtype: np.dtype, shape: tuple[int, int], where: str) -> np.ndarray:
        """Return elements of a buffer view, which may be unaligned, as a packed array of `shape`."""
        data, stride = self._document.view(view, f"{where}.bufferView")
        size = dtype.itemsize * shape[1]
        stride = stride or size
        if stride < size:
            raise InputError(f"is {stride} bytes, but an element has {size}", place=f"bufferViews[{view}].byteStride")
        end = offset + (shape[0] - 1) * stride + size
        if offset < 0 or end > len(data):
            raise InputError(f"{shape[0]} elements reach from byte {offset} to {end} of bufferViews[{view}], "
                             f"which has {len(data)} bytes", place=where)
        elements = np.ndarray(shape, dtype, data.data, offset, (stride, dtype.itemsize))
        return elements.astype(dtype.newbyteorder("="))

    def _with_sparse(self, array: np.ndarray, sparse: Any, where: str) -> np.ndarray:
        """Replace the elements of `array` that the sparse accessor lists."""
        if not 1 <= sparse.count <= len(array):
            raise InputError(f"must be 1 to {len(array)}, got {sparse.count}", place=f"{where}.count")
        index_type = _dtype(sparse.indices.componentType, f"{where}.indices")
        if index_type.kind != "u":
            raise InputError("must be an unsigned integer type", place=f"{where}.indices.componentType")
        rows = self._elements(sparse.indices.bufferView, sparse.indices.byteOffset, index_type, (sparse.count, 1),
                              f"{where}.indices")[:, 0]
        if rows.max() >= len(array):
            raise InputError(f"holds the index {int(rows.max())}, but there are {len(array)} elements", place=f"{where}.indices")
        values = sparse.values
        array[rows] = self._elements(values.bufferView, values.byteOffset, array.dtype.newbyteorder("<"),
                                     (sparse.count, array.shape[1]), f"{where}.values")
        return array


def require_finite(array: np.ndarray, where: str, rows: np.ndarray | None = None) -> None:
    """Raise InputError, with the first wrong row, unless the elements of an array, or only its `rows`, are finite."""
    bad = ~np.isfinite(array).all(axis=1)
    wrong = np.flatnonzero(bad) if rows is None else np.unique(rows[bad[rows]])
    if len(wrong):
        raise InputError(f"must be finite, but element {wrong[0]} is {array[wrong[0]].tolist()} ({len(wrong)} such elements)", place=where)


def _dtype(component_type: int, where: str) -> np.dtype:
    if component_type not in _DTYPES:
        raise InputError(f"must be one of {', '.join(map(str, _DTYPES))}, got {component_type}", place=f"{where}.componentType")
    return np.dtype(_DTYPES[component_type])


def _normalised(array: np.ndarray, where: str) -> np.ndarray:
    """Map 8- and 16-bit integers to float32 in [0, 1] or [-1, 1] by the specification's table, which clamps the most negative value."""
    if array.dtype.kind == "f" or array.dtype.itemsize > 2:
        raise InputError("only 8- and 16-bit integers can be normalised", place=f"{where}.normalized")
    return np.maximum(array.astype(np.float32) / np.float32(np.iinfo(array.dtype).max), np.float32(-1.0))
