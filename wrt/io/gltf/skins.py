"""Skinned meshes in the pose of the file's nodes, without animation. Source: Khronos, glTF 2.0 specification, section 3.7.3 (skins)."""

from functools import cached_property

import numpy as np

from wrt.core.errors import InputError
from wrt.io.gltf.accessors import Accessors
from wrt.io.gltf.document import Document, GltfObject
from wrt.io.gltf.nodes import local_matrix, parents_of


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
