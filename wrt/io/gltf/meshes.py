"""The node graph of a glTF file; its meshes; skins, which move vertices by nodes, without animation; instances of nodes.

Source: Khronos, glTF 2.0 specification, sections 3.5 (nodes) and 3.7 (meshes, skins); EXT_mesh_gpu_instancing, KHR_mesh_quantization.
"""

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TypeAlias

import numpy as np

from wrt.core.errors import InputError, at
from wrt.io.gltf.document import Accessors, Document, GltfObject, require_finite
from wrt.io.gltf.schema import read
from wrt.io.mesh_file import strip
from wrt.scene.clean import clean
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.values import as_transform, near_zero, require_count

# Attributes that need no warning here: wrt reads them, another warning names them (textures, TANGENT beside a normal map), or an
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


Targets: TypeAlias = list[tuple[float, dict[str, int]]]  # morph targets with their weights
TRIANGULATE: dict[int, Callable[[np.ndarray], np.ndarray]] = {4: _list_of_triangles, 5: strip, 6: _fan}
_NOT_TRIANGLES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}


def walk(document: Document) -> Iterator[tuple[int, GltfObject, np.ndarray]]:
    """Yield index, node and matrix to world space, (4, 4) float64, of each visible node of the default scene, parents before children.

    KHR_node_visibility hides a node with all nodes below it.
    Raises InputError if any node of the file has two parents or is its own ancestor."""
    parents_of(document)
    stack = [(index, place, np.eye(4)) for index, place in reversed(_roots(document))]
    seen: set[int] = set()
    while stack:
        index, place, parent = stack.pop()
        node = document.item("nodes", index, place)
        if index in seen:
            raise InputError(f"nodes[{index}] is in the scene twice", place=place)
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):  # `Object` refuses infinite matrices
            world = parent @ local_matrix(node, f"nodes[{index}]")
        if not document.extension_or_defaults(node, "KHR_node_visibility", f"nodes[{index}]").visible:
            continue
        yield index, node, world
        children = [(child, f"nodes[{index}].children[{i}]", world) for i, child in enumerate(node.children)]
        stack += reversed(children)


def _roots(document: Document) -> list[tuple[int, str]]:
    if document.gltf.scene is None and not document.raw("scenes"):
        parents = parents_of(document)
        return [(index, "nodes") for index in range(len(document.raw("nodes"))) if index not in parents]
    first = document.gltf.scene or 0
    scene = document.item("scenes", first, "scene")
    document.left_out.add_extensions(scene.extensions, "scene", scene.name or str(first))
    return [(index, f"scenes[{first}].nodes[{i}]") for i, index in enumerate(scene.nodes)]


def parents_of(document: Document) -> dict[int, int]:
    """Return the parent of each node that has one. Raises InputError if a node has two parents or is its own ancestor."""
    nodes = [read({"children": [int]}, raw, f"nodes[{index}]") for index, raw in enumerate(document.raw("nodes"))]
    parent: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for i, child in enumerate(node.children):
            place = f"nodes[{index}].children[{i}]"
            if not 0 <= child < len(nodes):
                raise InputError(f"is {child}, but there are {len(nodes)} nodes", place=place)
            if child in parent:
                raise InputError(f"nodes[{child}] has two parents, the first is nodes[{parent[child]}]", place=place)
            parent[child] = index
    # Here every node has at most one parent, so that a node that no root reaches is on a cycle or below a cycle.
    reached = [index for index in range(len(nodes)) if index not in parent]
    for index in reached:
        reached += nodes[index].children
    if len(reached) < len(nodes):
        first = min(set(range(len(nodes))) - set(reached))
        raise InputError("the node graph has a cycle", place=f"nodes[{first}]")
    return parent


def local_matrix(node: GltfObject, place: str) -> np.ndarray:
    """Return a node's own transform (4, 4) float64: its matrix, or translation * rotation * scale."""
    if node.matrix is not None:
        with at(f"{place}.matrix"):
            return as_transform(np.array(node.matrix).reshape(4, 4).T, "it")
    if not any(node.rotation):
        raise InputError("must be a unit quaternion, got zero", place=f"{place}.rotation")
    return compose(np.array([node.translation]), np.array([node.rotation]), np.array([node.scale]))[0]


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return matrices (N, 4, 4), translation * rotation * scale. rotation: quaternions x, y, z, w, (N, 4), of any length."""
    rotation = rotation / np.abs(rotation).max(axis=1, keepdims=True)  # the square of the length must not underflow
    x, y, z, w = (rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).T
    columns = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)],
        [2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)],
        [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    matrices = np.zeros((len(x), 4, 4))
    matrices[:, :3, :3] = np.array(columns).transpose(2, 1, 0) * scale[:, None, :]
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1.0
    return matrices


class Skins:
    """Cache of the joint matrices of skins."""

    def __init__(self, document: Document, accessors: Accessors) -> None:
        self._document, self._accessors = document, accessors
        self._matrices: dict[int, np.ndarray] = {}

    def blend(self, skin: int, primitive: GltfObject, count: int, place: str) -> np.ndarray:
        """Return the matrices (count, 3, 4) that move each vertex of a primitive to world space; weights are scaled to a sum of 1."""
        matrices, sets = self._joints(skin, place), sum(name.startswith("JOINTS_") for name in primitive.attributes)
        joints, weights = (np.concatenate([self._accessors.read(
            primitive.attributes.get(f"{name}_{i}", -1), "VEC4", f"{place}.attributes.{name}_{i}") for i in range(sets)], axis=1)
            for name in ("JOINTS", "WEIGHTS"))
        if joints.shape != weights.shape or len(joints) != count:
            raise InputError(f"have {len(joints)} and {len(weights)} elements, but POSITION has {count}",
                             place=f"{place}.attributes: JOINTS_0 and WEIGHTS_0")
        joints = np.where(weights != 0.0, joints, 0).astype(np.int64)  # the joint of a weight of 0 may be anything
        if joints.max() >= len(matrices):
            raise InputError(f"is {joints.max()}, but there are {len(matrices)} joints", place=f"{place}.attributes.JOINTS_0")
        total = weights.sum(axis=1, keepdims=True, dtype=np.float64)
        weights = np.divide(weights, total, out=np.eye(1, weights.shape[1]).repeat(count, axis=0), where=total != 0.0)
        out = np.zeros((count, 3, 4))
        for i in range(weights.shape[1]):
            out += weights[:, i, None, None] * matrices[joints[:, i], :3]
        return out

    def _joints(self, skin: int, place: str) -> np.ndarray:
        """Return the matrices (J, 4, 4) of a skin's joints: mesh space to world space."""
        if skin not in self._matrices:
            source, where = self._document.item("skins", skin, place), f"skins[{skin}]"
            worlds = np.array([self._world(joint, f"{where}.joints[{i}]") for i, joint in enumerate(source.joints)])
            if not len(worlds):
                raise InputError("must hold one joint or more", place=f"{where}.joints")
            if source.inverseBindMatrices is not None:
                inverse = self._accessors.read(source.inverseBindMatrices, "MAT4", f"{where}.inverseBindMatrices")
                if len(inverse) < len(worlds):
                    raise InputError(f"has {len(inverse)} matrices for {len(worlds)} joints", place=f"{where}.inverseBindMatrices")
                worlds = worlds @ inverse[:len(worlds)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
            self._matrices[skin] = worlds
        return self._matrices[skin]

    @cached_property
    def _parents(self) -> dict[int, int]:
        return parents_of(self._document)

    def _world(self, joint: int | None, place: str) -> np.ndarray:
        """Return the matrix (4, 4) of a node to world space, whether the scene shows the node or not."""
        world = np.eye(4)
        while joint is not None:
            world = local_matrix(self._document.item("nodes", joint, place), f"nodes[{joint}]") @ world
            joint = self._parents.get(joint)
        return world


def moved(blend: np.ndarray, points: np.ndarray, normals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Return points and normals (V, 3) moved by matrices (V, 3, 4), and True if these mirror: faces then need the other winding."""
    a, b, c = np.moveaxis(blend[:, :, :3], 2, 0)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    determinants = np.einsum("vi,vi->v", a, cofactors[:, :, 0])
    if normals is not None:  # by the inverse transpose, but for a positive factor
        normals = np.einsum("vij,vj->vi", cofactors, normals) * np.sign(determinants)[:, None]
    return np.einsum("vij,vj->vi", blend[:, :, :3], points) + blend[:, :, 3], normals, bool(np.median(determinants) < 0.0)


class Meshes:
    """Cache of meshes: primitives with the same accessors, mode, weights of morph targets and skin share a Mesh."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self._accessors = Accessors(document)
        self._skins = Skins(document, self._accessors)
        self._meshes: dict[tuple[object, ...], Mesh | None] = {}
        self._instances = 0

    def mesh(self, primitive: GltfObject, name: str, place: str, weights: tuple[float, ...] = (), skin: int | None = None) -> Mesh | None:
        """Return the mesh of a primitive, or None if it has no triangle with an area.

        weights: of the morph targets, 0 for missing ones; skin: index of a skin that moves the vertices to world space, or None."""
        left_out, attributes = self._document.left_out, primitive.attributes
        if primitive.mode not in TRIANGULATE and primitive.mode not in _NOT_TRIANGLES:
            raise InputError(f"must be 0 to 6, got {primitive.mode}", place=f"{place}.mode")
        if primitive.mode in _NOT_TRIANGLES or "POSITION" not in attributes:
            left_out.add(_NOT_TRIANGLES.get(primitive.mode, "primitives without POSITION"), "mesh", name)
            return None
        for attribute in sorted(attributes):
            if not attribute.startswith(_NO_WARNING):
                left_out.add(attribute, "mesh", name)
        targets = [(weight, target) for weight, target in zip(weights, primitive.targets, strict=False) if weight]
        key = (*(attributes.get(a) for a in ("POSITION", "NORMAL", "TEXCOORD_0")), primitive.indices, primitive.mode,
               *((weight, *sorted(target.items())) for weight, target in targets),
               *((skin, *sorted(attributes.items())) if skin is not None else ()))
        if key not in self._meshes:
            self._meshes[key] = self._make(primitive, name, place, targets, skin)
        if self._meshes[key] is None:
            left_out.add("primitives without a triangle that has an area", "mesh", name)
        return self._meshes[key]

    def _make(self, primitive: GltfObject, name: str, place: str, targets: Targets, skin: int | None) -> Mesh | None:
        positions = self._attribute(primitive, "POSITION", "VEC3", place, targets)
        indices = self._indices(primitive, len(positions), place)
        require_finite(positions, f"{place}.attributes.POSITION: accessors[{primitive.attributes['POSITION']}]", indices)
        normals, uvs = (self._optional(primitive, *each, place, targets, name, len(positions))
                        for each in (("NORMAL", "VEC3"), ("TEXCOORD_0", "VEC2")))
        if primitive.mode == 4 and len(indices) % 3:
            self._document.left_out.add("incomplete last triangles", "mesh", name)
        faces = TRIANGULATE[primitive.mode](indices)
        if skin is not None:
            blend = self._skins.blend(skin, primitive, len(positions), place)
            positions, normals, mirrored = moved(blend, positions, normals)
            faces = faces[:, ::-1] if mirrored else faces
        with at(place):
            near, origin = near_zero(positions)  # a skin may move the mesh far from 0
            cleaned = clean(near, faces, normals, uvs)
            if not len(cleaned.faces):
                return None
            normals = None if cleaned.normals is None else unit_rows(cleaned.normals)  # the length of quantised ones is off by 1 %
            return Mesh(cleaned.vertices, cleaned.faces, normals, cleaned.uvs, dropped=cleaned.dropped, name=name, origin=origin)

    def _attribute(self, primitive: GltfObject, attribute: str, kind: str, place: str, targets: Targets) -> np.ndarray:
        """Return an attribute, float32, or float64 if morph targets change it. It may hold NaN and infinity."""
        where = f"{place}.attributes.{attribute}"
        array: np.ndarray = self._accessors.read(primitive.attributes[attribute], kind, where, finite=False).astype(np.float32, copy=False)
        for weight, target in targets:
            if attribute in target:
                where = f"{place}.targets: {attribute}"
                delta = self._accessors.read(target[attribute], kind, where, finite=False)
                if len(delta) != len(array):
                    raise InputError(f"has {len(delta)} elements, but the primitive has {len(array)}", place=where)
                array = array + weight * delta.astype(np.float64)
        return array

    def _optional(self, primitive: GltfObject, attribute: str, kind: str, place: str, targets: Targets, name: str,
                  count: int) -> np.ndarray | None:
        """Return an attribute that the shape does not need. Mistakes are recorded: it is then None, or 0 where it is not finite."""
        if attribute not in primitive.attributes:
            return None
        try:
            array = self._attribute(primitive, attribute, kind, place, targets)
            if len(array) != count:
                raise InputError(f"has {len(array)} elements, but POSITION has {count}", place=f"{place}.attributes.{attribute}")
        except InputError as error:
            self._document.mistakes.add(f"{attribute}, because {error}", "mesh", name)
            return None
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            self._document.mistakes.add(f"{attribute} that is not finite, now 0", "mesh", name)
        return np.where(bad[:, None], np.float32(0.0), array) if bad.any() else array

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
        instancing = self._document.extension(node, "EXT_mesh_gpu_instancing", place)
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
