"""Trees of boxes as plain arrays: what a BVH gives away, and what another builder's tree is read from."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.core.checks import as_path, shown
from wrt.core.errors import InputError
from wrt.core.files import require_file, write_bytes
from wrt.core.types import PathLike

MOST_CHILDREN = 8
MAX_LEAF = 64  # primitives
ABSENT, INNER = -1, 0  # values of `count` for a child that does not exist, and for an inner node


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A tree of N nodes with up to W children each. Node 0 is the root.

    Attributes
    ----------
    lo, hi : (N, W, 3) float32
        Boxes of the children; not read for a child that does not exist.
    child : (N, W) int32
        Of an inner node its index; of a leaf the index in `primitives` of its first primitive.
    count : (N, W) int32
        Of a leaf the number of its primitives, 1 to 64; 0: inner node; -1: no child.
    primitives : (R,) int32
        prim_ids of the leaves.
    """

    lo: np.ndarray
    hi: np.ndarray
    child: np.ndarray
    count: np.ndarray
    primitives: np.ndarray

    @property
    def width(self) -> int:
        return self.child.shape[1]

    def save(self, path: PathLike) -> None:
        """Write the arrays to a .npz file, which np.load reads without wrt. Raises InputError if it cannot be written."""
        if as_path(path, "path").suffix.lower() != ".npz":
            raise InputError("the file of a tree must have the suffix .npz", path=path)
        data = io.BytesIO()
        arrays: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        np.savez(data, allow_pickle=False, **arrays)
        write_bytes(path, data.getvalue())

    @classmethod
    def of(cls, tree: BoxTree | Mapping[str, Any] | PathLike) -> BoxTree:
        """Convert a tree, a mapping with its arrays, or the path of a .npz file, and check shapes and types. Raises InputError."""
        if isinstance(tree, BoxTree | Mapping):
            return cls.from_arrays(vars(tree) if isinstance(tree, BoxTree) else tree)
        path = as_path(tree, "tree")
        require_file(path)
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls.from_arrays(data)
        except InputError as error:
            raise error.at(path) from error
        except Exception as error:  # zipfile, zlib and NumPy raise many kinds
            raise InputError(f"is not a tree ({type(error).__name__}: {error})", path=path) from error

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> BoxTree:
        out = {}
        for each in fields(cls):
            if each.name not in arrays:
                raise InputError(f"has no array {each.name!r}", place="tree")
            array = np.asarray(arrays[each.name])
            kinds = "fiu" if each.name in ("lo", "hi") else "iu"
            if array.dtype.kind not in kinds:
                raise InputError(f"must be an array of {'numbers' if kinds == 'fiu' else 'integers'}, got {shown(array)}",
                                 place=f"tree: {each.name}")
            out[each.name] = array
        n, width = out["child"].shape if out["child"].ndim == 2 else (0, 0)
        if n < 1 or not 1 <= width <= MOST_CHILDREN:
            raise InputError(f"must be (N, W) with N >= 1 and W from 1 to {MOST_CHILDREN}, got {shown(out['child'])}", place="tree: child")
        shapes = {"lo": (n, width, 3), "hi": (n, width, 3), "count": (n, width), "primitives": out["primitives"].shape[:1]}
        for name, shape in shapes.items():
            if out[name].shape != shape:
                raise InputError(f"must be {shape}, got {shown(out[name])}", place=f"tree: {name}")
        with np.errstate(over="ignore"):
            boxes = {name: np.ascontiguousarray(out[name], np.float32) for name in ("lo", "hi")}
        return cls(**boxes, **{name: out[name].astype(np.int64) for name in ("child", "count", "primitives")})

    def levels(self) -> list[np.ndarray]:
        """Return the indices of the nodes of each level, the root first."""
        out = [np.zeros(1, np.int64)]
        while len(below := self.child[out[-1]][self.count[out[-1]] == INNER]):
            out.append(below)
        return out

    def checked(self, geometry: Geometry, spatial_splits: bool = False) -> BoxTree:
        """Return the tree in depth-first order, with boxes that contain the padded boxes of its primitives, so that no ray is lost.

        After spatial splits, the boxes of leaves stay as they are. Raises InputError if the arrays are no tree over the geometry.
        """
        tree, n = self.depth_first(), len(geometry)
        if ((tree.primitives < 0) | (tree.primitives >= n)).any():
            raise InputError(f"must be prim_ids, 0 to {n - 1}", place="tree: primitives")
        times = np.bincount(tree.primitives, minlength=n)
        if (wrong := (times != 1) & ((times == 0) | (not spatial_splits))).any():
            i = int(np.argmax(wrong))
            raise InputError(f"is in the leaves {times[i]} times", place=f"tree: primitive {i}",
                             hint="pass spatial_splits=True if the builder splits primitives" if times[i] else None)
        absent = (tree.count == ABSENT)[..., None]
        lo, hi = np.where(absent, np.float32(np.inf), tree.lo), np.where(absent, np.float32(-np.inf), tree.hi)
        require(~np.isnan(np.concatenate([lo, hi], axis=2)).any(axis=2), "the box has a NaN")
        if not spatial_splits:
            leaf = np.flatnonzero(tree.count > 0)
            leaf = leaf[np.argsort(tree.child.flat[leaf])]  # in the order of their primitives
            owner, bounds = np.repeat(leaf, tree.count.flat[leaf]), geometry.bounds()
            np.minimum.at(lo.reshape(-1, 3), owner, bounds[0][tree.primitives])
            np.maximum.at(hi.reshape(-1, 3), owner, bounds[1][tree.primitives])
        return nested(replace(tree, lo=lo, hi=hi))

    def depth_first(self) -> BoxTree:
        """Return the tree with its nodes and primitives in depth-first order. Raises InputError if the links form no tree."""
        (n, width), size, inner = self.child.shape, len(self.primitives), self.count == INNER
        within = (self.child >= 0) & (self.child + self.count <= size)
        require((self.count >= ABSENT) & (self.count <= MAX_LEAF), f"`count` must be -1 (none), 0 (inner node) or 1 to {MAX_LEAF} (leaf)")
        require(~inner | ((self.child > 0) & (self.child < n)), f"`child` must be a node, 1 to {n - 1}")
        require((self.count < 1) | within, f"the leaf leads beyond `primitives`, which has {size}")
        child, count = self.child.reshape(-1).tolist(), self.count.reshape(-1).tolist()
        nodes: list[int] = []
        leaves: list[int] = []  # as places in `child`
        met, places = np.zeros(n, bool), [-1]
        while places:
            place = places.pop()
            if place >= 0 and count[place] > 0:
                leaves.append(place)
                continue
            node = 0 if place < 0 else child[place]
            if met[node]:
                raise InputError("is the child of two nodes, or below itself", place=f"tree: node {node}")
            met[node] = True
            nodes.append(node)
            places += [each for each in range((node + 1) * width - 1, node * width - 1, -1) if count[each] != ABSENT]
        if not met.all():
            raise InputError("is not reached from node 0, the root", place=f"tree: node {int(np.argmin(met))}")
        counts, links = self.count.flat[leaves], np.where(inner, np.argsort(nodes)[np.where(inner, self.child, 0)], 0)
        before = np.cumsum(counts) - counts
        links.flat[leaves] = before
        source = np.repeat(self.child.flat[leaves] - before, counts) + np.arange(counts.sum())
        return BoxTree(self.lo[nodes], self.hi[nodes], links[nodes], self.count[nodes], self.primitives[source])


def require(good: np.ndarray, what: str) -> None:
    """Raise InputError at the first node and child where `good`, (N, W) bool, is False."""
    if not good.all():
        node, k = map(int, np.argwhere(~good)[0])
        raise InputError(what, place=f"tree: node {node}, child {k}")


def nested(tree: BoxTree) -> BoxTree:
    """Return the tree with boxes that contain the boxes of their node's children. Boxes rounded to few bits may not."""
    lo, hi, inner = tree.lo.copy(), tree.hi.copy(), tree.count == INNER
    for level in reversed(tree.levels()):
        at = np.where(inner[level], tree.child[level], 0)
        mask = inner[level][..., None]
        lo[level] = np.where(mask, np.minimum(lo[level], lo[at].min(axis=2)), lo[level])
        hi[level] = np.where(mask, np.maximum(hi[level], hi[at].max(axis=2)), hi[level])
    return replace(tree, lo=lo, hi=hi)
