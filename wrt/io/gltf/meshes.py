"""Meshes of a glTF file, and instances of its nodes.

Source: Khronos, glTF 2.0 specification, section 3.7; EXT_mesh_gpu_instancing, KHR_mesh_quantization.
"""

from collections.abc import Callable

import numpy as np

from wrt.core.errors import InputError, at
from wrt.io.gltf.accessors import Accessors
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.draco import decode
from wrt.io.gltf.nodes import compose
from wrt.io.gltf.schema import Instancing
from wrt.io.polygons import strip
from wrt.scene.clean import clean
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.values import require_count

# Attributes that need no warning here: wrt reads them, another warning names them (skins, textures, TANGENT beside a normal map), or an
# application defines them (underscore).
_NO_WARNING = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_", "JOINTS_", "WEIGHTS_", "_")
# Attributes of a node's instances, with their types and defaults.
_INSTANCE_ATTRIBUTES: dict[str, tuple[str, tuple[float, ...]]] = {
    "TRANSLATION": ("VEC3", (0.0, 0.0, 0.0)),
    "ROTATION": ("VEC4", (0.0, 0.0, 0.0, 1.0)),
    "SCALE": ("VEC3", (1.0, 1.0, 1.0)),
}


def _list_of_triangles(indices: np.ndarray) -> np.ndarray:
    return indices[:len(indices) // 3 * 3].reshape(-1, 3)


def _fan(indices: np.ndarray) -> np.ndarray:
    i = np.arange(max(len(indices) - 2, 0), dtype=indices.dtype)
    return indices[np.stack([i + 1, i + 2, np.zeros_like(i)], axis=1)]


TRIANGULATE: dict[int, Callable[[np.ndarray], np.ndarray]] = {4: _list_of_triangles, 5: strip, 6: _fan}
_NOT_TRIANGLES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


class Meshes:
    """Cache of meshes: primitives with the same accessors and mode share a Mesh."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._accessors = Accessors(document)
        self._meshes: dict[tuple[object, ...], Mesh | None] = {}
        self._instances = 0

    def mesh(self, primitive: GltfObject, name: str, place: str) -> Mesh | None:
        """Return the mesh of a primitive, or None if it has no triangle with an area."""
        left_out, attributes = self._document.left_out, primitive.attributes
        if primitive.mode not in TRIANGULATE and primitive.mode not in _NOT_TRIANGLES:
            raise InputError(f"must be 0 to 6, got {primitive.mode}", place=f"{place}.mode")
        if primitive.mode in _NOT_TRIANGLES or "POSITION" not in attributes:
            left_out.add(_NOT_TRIANGLES.get(primitive.mode, "primitives without POSITION"), "mesh", name)
            return None
        for attribute in sorted(attributes):
            if not attribute.startswith(_NO_WARNING):
                left_out.add(attribute, "mesh", name)
        if primitive.targets:
            left_out.add("morph targets", "mesh", name)
        key = (*(attributes.get(a) for a in ("POSITION", "NORMAL", "TEXCOORD_0")), primitive.indices, primitive.mode)
        if key not in self._meshes:
            self._meshes[key] = self._make(primitive, name, place)
        if self._meshes[key] is None:
            left_out.add("primitives without a triangle that has an area", "mesh", name)
        return self._meshes[key]

    def _make(self, primitive: GltfObject, name: str, place: str) -> Mesh | None:
        decode(self._document, self._accessors, primitive, place)
        positions = self._attribute(primitive, "POSITION", "VEC3", place)
        normals = self._attribute(primitive, "NORMAL", "VEC3", place)
        uvs = self._attribute(primitive, "TEXCOORD_0", "VEC2", place)
        assert positions is not None
        for attribute, array in (("NORMAL", normals), ("TEXCOORD_0", uvs)):
            if array is not None and len(array) != len(positions):
                raise InputError(f"has {len(array)} elements, but POSITION has {len(positions)}", place=f"{place}.attributes.{attribute}")
        indices = self._indices(primitive, len(positions), place)
        if primitive.mode == 4 and len(indices) % 3:
            self._document.left_out.add("incomplete last triangles", "mesh", name)
        with at(place):
            cleaned = clean(positions, TRIANGULATE[primitive.mode](indices), normals, uvs)
            if not len(cleaned.faces):
                return None
            normals = None if cleaned.normals is None else unit_rows(cleaned.normals)  # the length of quantised ones is off by 1 %
            return Mesh(cleaned.vertices, cleaned.faces, normals, cleaned.uvs, dropped=cleaned.dropped, name=name)

    def _attribute(self, primitive: GltfObject, attribute: str, kind: str, place: str) -> np.ndarray | None:
        index = primitive.attributes.get(attribute)
        if index is None:
            return None
        return self._accessors.read(index, kind, f"{place}.attributes.{attribute}").astype(np.float32, copy=False)

    def _indices(self, primitive: GltfObject, count: int, place: str) -> np.ndarray:
        if primitive.indices is None:
            return np.arange(count, dtype=np.int32)
        where = f"{place}.indices"
        indices = self._accessors.read(primitive.indices, "SCALAR", where)[:, 0]
        if indices.dtype.kind != "u":
            raise InputError("must be of an unsigned integer type, not normalised", place=where)
        if indices.max() >= count:
            i = int(np.argmax(indices >= count))
            raise InputError(f"index {i} is {int(indices[i])}, but there are {count} vertices", place=where)
        return indices.astype(np.int32)  # no overflow: an accessor has at most 2^31 - 1 elements

    def instances(self, node: GltfObject, place: str) -> np.ndarray | None:
        """Return the transforms (N, 4, 4) of a node's instances, instance to node, or None if the node has no instances."""
        instancing = self._document.extension(node, "EXT_mesh_gpu_instancing", Instancing, place)
        if instancing is None:
            return None
        place = f"{place}.extensions.EXT_mesh_gpu_instancing.attributes"
        wanted = _INSTANCE_ATTRIBUTES
        found = {name: self._accessors.read(index, wanted[name][0], f"{place}.{name}").astype(np.float64)
                 for name, index in instancing.attributes.items() if name in wanted}
        counts = {len(array) for array in found.values()}
        if len(counts) != 1:
            raise InputError(f"must hold accessors of equal length, got {sorted(counts) or 'none'}", place=place)
        if "ROTATION" in found and not found["ROTATION"].any(axis=1).all():
            raise InputError("must hold unit quaternions, but one is zero", place=f"{place}.ROTATION")
        count = counts.pop()
        self._instances += count
        with at(place):
            require_count(self._instances, "instances")
        return compose(*(found.get(name, np.broadcast_to(default, (count, len(default))))
                         for name, (_, default) in wanted.items()))
