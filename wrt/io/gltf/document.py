"""A glTF 2.0 file: the container (.gltf, .glb), its JSON, its buffers and accessors, and the files that it refers to.

Source: Khronos, glTF 2.0 specification, sections 2 (concepts), 3.6 (buffers, accessors) and 4 (GLB); KHR_mesh_quantization for integer
positions. Compressed meshes (COMPRESSIONS) are not decoded: a file that does not require a compression has plain buffers beside it.
"""

import base64
import json
import re
import struct
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import unquote_to_bytes

import numpy as np

from wrt.core.checks import listed, short
from wrt.core.errors import InputError, at
from wrt.core.files import read_file
from wrt.core.types import JsonObject, PathLike
from wrt.io.gltf.schema import EXTENSIONS, FILE, ITEMS, read

GltfObject: TypeAlias = Any  # a namespace with the keys that wrt.io.gltf.schema declares
GLB_MAGIC = b"glTF"
_CHUNK_JSON, _CHUNK_BIN = 0x4E4F534A, 0x004E4942
COMPRESSIONS = frozenset({"KHR_draco_mesh_compression", "KHR_meshopt_compression", "EXT_meshopt_compression"})
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_COUNT = 2**31 - 1
_MAX_IMPLICIT_COUNT = 2**22  # elements without a buffer, which are zeros: a file of a few bytes must not fill the memory

SUPPORTED_EXTENSIONS = frozenset({*EXTENSIONS, "KHR_mesh_quantization"})
# Extensions that describe the file or its use, and change no pixel.
METADATA_EXTENSIONS = frozenset({
    "KHR_xmp", "KHR_xmp_json_ld", "KHR_animation_pointer", "KHR_interactivity", "KHR_node_selectability",
    "KHR_node_hoverability", "KHR_audio_emitter", "EXT_structural_metadata", "EXT_mesh_features",
    "EXT_instance_features", "AGI_articulations", "AGI_stk_metadata", "FB_geometry_metadata", "MSFT_audio_emitter",
    "MSFT_lod", "KHR_physics_rigid_bodies", "KHR_implicit_shapes", "EXT_mesh_manifold", "GODOT_single_root", "GRIFFEL_bim_data",
    "VRMC_vrm",  # unlike VRM, whose version 0 has materials
})
DEFAULT_LOOK = frozenset({"KHR_materials_variants"})  # wrt shows the default look
_LOOKS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "EXT_lights_", "MSFT_texture_")  # shapes do not need them


class LeftOut:
    """Features of a file that wrt leaves out of the picture or changes, each with the objects that have it."""

    def __init__(self) -> None:
        self._places: dict[str, dict[str, None]] = {}

    def add(self, feature: str, kind: str, name: str) -> None:
        """Record that the object `name` has `feature`. kind: the object's kind, such as "material" or "node"."""
        self._places.setdefault(feature, {})[f"{kind} {short(name)}"] = None

    def add_extensions(self, extensions: JsonObject | None, kind: str, name: str) -> None:
        """Record the extensions of an object that could change the picture and are not read by wrt."""
        for extension in extensions or ():
            if extension not in SUPPORTED_EXTENSIONS | METADATA_EXTENSIONS | COMPRESSIONS:
                self.add(extension, kind, name)

    def clamp(self, value: Any, low: float, high: float, what: str, kind: str, name: str) -> Any:
        """Return a number or a list of numbers in [low, high], and record a value outside, because exporters write colours of 1.0001."""
        clamped = np.clip(value, low, high)
        if np.array_equal(clamped, value):
            return value
        self.add(f"{what} outside of [{low:g}, {high:g}]", kind, name)
        return clamped.tolist()

    def sentence(self) -> str:
        """Return all features in one line, each with its first five objects; "" without features."""
        return ", ".join(f"{feature} ({', '.join([*places][:5])}{f' and {len(places) - 5} more' * (len(places) > 5)})"
                         for feature, places in self._places.items())


class Document:
    """JSON of a file, typed where it is read, and the bytes that it refers to. The caller adds the path to each InputError.

    gltf: the file's object without its arrays, whose items `item` returns. shapes_only: accept files that require extensions of
    materials, textures and lights. left_out: what wrt does not support; mistakes: what is wrong in the file and is left out or changed."""

    def __init__(self, path: PathLike, shapes_only: bool = False) -> None:
        self.path = Path(path)
        raw, self._binary = _read_container(self.path)
        if not isinstance(raw, dict):
            raise InputError("is not a glTF file: its JSON is not an object")
        self._raw, self._items = raw, dict[tuple[str, int], GltfObject]()
        self.gltf: GltfObject = read(FILE, raw, "")
        for key, readable in (("version", r"2\.\d+"), ("minVersion", r"2\.0")):  # readers of 2.0 may read any 2.x
            version = getattr(self.gltf.asset, key)
            if version is not None and not re.fullmatch(readable, version):
                raise InputError(f"is {short(version)}; wrt reads 2.0", place=f"asset.{key}")
        unknown = set(self.gltf.extensionsRequired) - SUPPORTED_EXTENSIONS - METADATA_EXTENSIONS - DEFAULT_LOOK
        unknown = {each for each in unknown if not (shapes_only and each.startswith(_LOOKS))}
        if unknown:
            hint = "decompress the meshes: gltf-transform copy IN OUT" if unknown <= COMPRESSIONS else "save the file without it"
            raise InputError(f"the file needs {listed(sorted(unknown))}, which wrt does not support", place="extensionsRequired", hint=hint)
        self.left_out, self.mistakes = LeftOut(), LeftOut()
        self._buffers: dict[int, np.ndarray] = {}

    def raw(self, array: str) -> list[Any]:
        """Return the unchecked items of an array of the file; [] if it has none."""
        items = self._raw.get(array)
        if not isinstance(items, list | None):
            raise InputError(f"must be an array, got {short(items)}", place=array)
        return items or []

    def item(self, array: str, index: int, place: str) -> GltfObject:
        """Return item `index` of an array of the file. Raises InputError at `place` if the index is out of range, and for a wrong item.

        Items are checked when they are first used, so that a mistake in an unused one refuses no file."""
        items = self.raw(array)
        if not 0 <= index < len(items):
            raise InputError(f"is {index}, but there are {len(items)} {array}", place=place)
        if (array, index) not in self._items:
            self._items[array, index] = read(ITEMS[array], items[index], f"{array}[{index}]")
        return self._items[array, index]

    def extension(self, holder: GltfObject, name: str, place: str) -> GltfObject | None:
        """Return the extension `name` of a glTF object, or None."""
        raw = holder.extensions.get(name)
        return None if raw is None else read(EXTENSIONS[name], raw, f"{place}.extensions.{name}")

    def extension_or_defaults(self, holder: GltfObject, name: str, place: str) -> GltfObject:
        return self.extension(holder, name, place) or read(EXTENSIONS[name], {}, "")

    def view(self, index: int, place: str) -> tuple[np.ndarray, int | None]:
        """Return the bytes (N,) uint8 of a buffer view, and its stride in bytes or None."""
        view, where = self.item("bufferViews", index, place), f"bufferViews[{index}]"
        data = self._buffer(view.buffer, f"{where}.buffer")
        start, length = view.byteOffset, view.byteLength
        if length < 1:
            raise InputError(f"must be at least 1, got {length}", place=f"{where}.byteLength")
        if start < 0 or start + length > len(data):
            raise InputError(f"bytes {start} to {start + length} reach outside of buffers[{view.buffer}], "
                             f"which has {len(data)} bytes", place=where)
        return data[start:start + length], view.byteStride

    def _buffer(self, index: int, place: str) -> np.ndarray:
        if index not in self._buffers:
            buffer = self.item("buffers", index, place)
            where = f"buffers[{index}]"
            data: bytes | memoryview
            if buffer.uri is not None:
                data = self.resource(buffer.uri, f"{where}.uri")
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise InputError("has no uri, and the file has no binary chunk for it", place=where)
            if len(data) < buffer.byteLength:
                raise InputError(f"is truncated: byteLength is {buffer.byteLength}, but there are {len(data)} bytes", place=where)
            self._buffers[index] = np.frombuffer(data, dtype=np.uint8)[:max(buffer.byteLength, 0)]
        return self._buffers[index]

    def resource(self, uri: str, place: str) -> bytes:
        """Return the bytes of a data: URI, or of a file whose relative path stays in the folder of the glTF file."""
        if uri[:5].lower() == "data:":
            head, _, body = uri.partition(",")
            try:
                data = unquote_to_bytes(body)
                return base64.b64decode(data, validate=True) if head.lower().endswith(";base64") else data
            except ValueError as error:  # binascii.Error, and a lone surrogate
                raise InputError(f"is a data: URI that cannot be decoded: {error}", place=place) from None
        with at(f"{place}: {short(uri)}"):
            return read_file(self.path.parent / _local_name(uri))


class Accessors:
    """Reader of a document's accessors. Each accessor is decoded once, into a read-only array that all callers share."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._arrays: dict[int, np.ndarray] = {}

    def read(self, index: int, kind: str, place: str, finite: bool = True) -> np.ndarray:
        """Return accessor `index` as an array (count, components of `kind`): float32 for floats and normalised integers, else integers.

        kind: "SCALAR", "VEC2", "VEC3", "VEC4" or "MAT4". Raises InputError at `place` if the accessor has another kind, does not fit into
        its buffer view, or, if `finite`, holds a float that is not finite."""
        accessor, where = self._document.item("accessors", index, place), f"accessors[{index}]"
        if accessor.type != kind:
            raise InputError(f"must be of type {kind}, but {where} is {short(accessor.type)}", place=place)
        with at(place):
            if index not in self._arrays:
                self._arrays[index] = self._normalised(self._decode(accessor, where), accessor, where)
            if finite:
                require_finite(self._arrays[index], where)
        return self._arrays[index]

    def _normalised(self, array: np.ndarray, accessor: GltfObject, where: str) -> np.ndarray:
        """Return the read-only array of an accessor. Normalised: 8- and 16-bit integers become float32 in [0, 1] or [-1, 1] by the
        specification's table, which clamps the most negative value."""
        if accessor.normalized:
            if array.dtype.kind == "f" or array.dtype.itemsize > 2:
                raise InputError("only 8- and 16-bit integers can be normalised", place=f"{where}.normalized")
            array = np.maximum(array.astype(np.float32) / np.float32(np.iinfo(array.dtype).max), np.float32(-1.0))
        array.flags.writeable = False
        return array

    def _decode(self, accessor: GltfObject, where: str) -> np.ndarray:
        dtype, count = _dtype(accessor.componentType, where), accessor.count
        most = _MAX_COUNT if accessor.bufferView is not None else _MAX_IMPLICIT_COUNT
        if not 1 <= count <= most:
            raise InputError(f"must be 1 to {most}, got {count}", place=f"{where}.count")
        shape = (count, _WIDTHS[accessor.type])
        if accessor.bufferView is not None:
            array = self._elements(accessor.bufferView, accessor.byteOffset, dtype, shape, where)
        else:  # zeros, by the specification
            array = np.zeros(shape, dtype)
        return array if accessor.sparse is None else self._with_sparse(array, accessor.sparse, f"{where}.sparse")

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

    def _with_sparse(self, array: np.ndarray, sparse: GltfObject, where: str) -> np.ndarray:
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


def _read_container(path: Path) -> tuple[object, memoryview | None]:
    """Return the parsed JSON and the binary chunk of a .gltf or .glb file, whose first four bytes distinguish the formats."""
    data = read_file(path)
    chunks: dict[int, memoryview] = {}
    if data[:4] == GLB_MAGIC:
        chunks = _chunks(data)
    elif path.suffix.lower() == ".glb":
        raise InputError(f"is not a .glb file: it starts with {data[:4]!r}, not {GLB_MAGIC!r}")
    try:
        return json.loads(bytes(chunks.get(_CHUNK_JSON, data))), chunks.get(_CHUNK_BIN)  # NaN is refused where it is used
    except RecursionError:
        raise InputError("is not valid JSON: nested too deeply") from None
    except ValueError as error:  # no JSON, no UTF-8, or an integer of thousands of digits
        raise InputError(f"is not valid JSON: {error}") from None


def _chunks(data: bytes) -> dict[int, memoryview]:
    """Return the chunks of a .glb file by their kind; the first of each kind counts."""
    version, length = struct.unpack("<II", data[4:12].ljust(8, b"\0"))
    if not 12 <= length <= len(data):
        raise InputError(f"is truncated: it has {len(data)} bytes, but its header announces {length}", place="header")
    if version != 2:
        raise InputError(f"is glTF {version}; wrt reads 2.0", place="header")
    chunks: dict[int, memoryview] = {}
    end = 12
    while end + 8 <= length:
        size, kind = struct.unpack_from("<II", data, end)
        begin, end = end + 8, end + 8 + size
        if end > length:
            raise InputError(f"is truncated: it ends at byte {end}, the file at {length}", place=f"chunk {len(chunks)}")
        chunks.setdefault(kind, memoryview(data)[begin:end])
    if _CHUNK_JSON not in chunks:
        raise InputError("has no JSON chunk")
    return chunks


def _local_name(uri: str) -> str:
    """Return the relative path of a URI. Raises InputError for a path that leaves the folder, because the file is untrusted."""
    try:
        name = unquote_to_bytes(uri).decode().replace("\\", "/")
    except UnicodeError:
        name = ""
    is_address = re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name) is not None
    if not name or is_address or name.startswith("/") or ".." in name.split("/") or any(ord(character) < 32 for character in name):
        raise InputError("is no path of a file in the folder of the glTF file or below", hint="copy the file beside the glTF file")
    return name
