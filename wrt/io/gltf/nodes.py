"""The node graph of a glTF file, and the transforms of its nodes. Source: Khronos, glTF 2.0 specification, section 3.5."""

from collections.abc import Iterator

import numpy as np

from wrt.core.errors import InputError, at
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.schema import Children, Visibility, exactly, read_as
from wrt.scene.values import as_transform


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
        if not (document.extension(node, "KHR_node_visibility", Visibility, f"nodes[{index}]") or Visibility()).visible:
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
    nodes = [read_as(Children, raw, f"nodes[{index}]") for index, raw in enumerate(document.raw("nodes"))]
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
            return as_transform(np.array(exactly(node.matrix, 16, "")).reshape(4, 4).T, "it")
    translation = exactly(node.translation or [0.0] * 3, 3, f"{place}.translation")
    scale = exactly(node.scale if node.scale is not None else [1.0] * 3, 3, f"{place}.scale")
    rotation = exactly(node.rotation or [0.0, 0.0, 0.0, 1.0], 4, f"{place}.rotation")
    if not any(rotation):
        raise InputError("must be a unit quaternion, got zero", place=f"{place}.rotation")
    return compose(np.array([translation]), np.array([rotation]), np.array([scale]))[0]


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
