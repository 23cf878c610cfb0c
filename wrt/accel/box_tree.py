"""Trees of boxes as plain arrays: what a BVH gives away, and what another builder's tree is read from."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.checks import as_path, shown
from wrt.core.device import launch, start, upload
from wrt.core.errors import InputError
from wrt.core.files import require_file, write_bytes
from wrt.core.types import PathLike

MOST_CHILDREN = 8
TRIANGLES_PER_LAUNCH = 16384
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
            out.append(below.astype(np.int64))
            if len(out) > len(self.child):
                break
        return out

    def checked(self, geometry: Geometry, spatial_splits: bool = False) -> BoxTree:
        """Return the tree with boxes that contain the padded boxes of its primitives, or raise InputError if it is not a tree of them."""
        check_links(self)
        check_primitives(self, len(geometry), spatial_splits)
        check_boxes(self, geometry, spatial_splits)
        absent = (self.count == ABSENT)[..., None]
        tree = replace(self, lo=np.where(absent, np.float32(np.inf), self.lo), hi=np.where(absent, np.float32(-np.inf), self.hi))
        return tree if spatial_splits else grown(tree, geometry)

    @property
    def in_order(self) -> bool:
        """Whether every child comes after its parent, and `primitives` has the leaves without gaps."""
        leaf, inner = self.count > 0, self.count == INNER
        after = (self.child > np.arange(len(self.child))[:, None])[inner].all()
        first, count = self.child[leaf], self.count[leaf]
        by_first = np.argsort(first, kind="stable")
        ends = np.cumsum(count[by_first])
        return bool(after and np.array_equal(first[by_first], ends - count[by_first]) and ends[-1:].sum() == len(self.primitives))

    def preorder(self) -> BoxTree:
        """Return the tree with its nodes and primitives in depth-first order."""
        levels, inner, n = self.levels(), self.count == INNER, len(self.child)
        nodes, held = np.ones(n, np.int64), np.zeros(n, np.int64)  # nodes and primitives of each subtree
        sizes = [np.zeros((n, self.width), np.int64), np.maximum(self.count, 0)]
        for level in reversed(levels):
            at = np.where(inner[level], self.child[level], 0)
            sizes[0][level] = np.where(inner[level], nodes[at], 0)
            sizes[1][level] = np.where(inner[level], held[at], sizes[1][level])
            nodes[level] = 1 + sizes[0][level].sum(axis=1)
            held[level] = sizes[1][level].sum(axis=1)
        index, first = np.zeros(n, np.int64), np.zeros((n, self.width), np.int64)
        begin = np.zeros(n, np.int64)  # first primitive of each subtree
        for level in levels:
            before = [np.cumsum(size[level], axis=1) - size[level] for size in sizes]
            first[level] = begin[level][:, None] + before[1]
            mask = inner[level]
            index[self.child[level][mask]] = (index[level][:, None] + 1 + before[0])[mask]
            begin[self.child[level][mask]] = first[level][mask]
        old = np.argsort(index)
        child = np.where(inner, index[np.where(inner, self.child, 0)], np.where(self.count > 0, first, 0))
        out = replace(self, lo=self.lo[old], hi=self.hi[old], child=child[old], count=self.count[old])
        leaf = self.count[old] > 0
        source, target, count = self.child[old][leaf], out.child[leaf], out.count[leaf]
        within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        primitives = np.zeros(len(within), np.int64)
        primitives[np.repeat(target, count) + within] = self.primitives[np.repeat(source, count) + within]
        return replace(out, primitives=primitives)


def require(good: np.ndarray, what: str, found: np.ndarray | None = None) -> None:
    """Raise InputError at the first node and child where `good`, (N, W) bool, is False. found: (N, W), values for the message."""
    if not good.all():
        node, k = map(int, np.argwhere(~good)[0])
        got = "" if found is None else f", got {found[node, k]}"
        raise InputError(what + got, place=f"tree: node {node}, child {k}")


def check_links(tree: BoxTree) -> None:
    """Raise InputError unless every node but the root is the child of one node, and can be reached from the root."""
    child, count, n = tree.child, tree.count, len(tree.child)
    inner = count == INNER
    require((count >= ABSENT) & (count <= MAX_LEAF), f"`count` must be -1 (no child), 0 (inner node) or 1 to {MAX_LEAF} (leaf)", count)
    require(~inner | ((child >= 0) & (child < n)), f"`child` must be a node, 0 to {n - 1}", child)
    require(~inner | (child != 0), "leads to node 0, the root, which has no parent")
    if n > 1 and (count == ABSENT).all(axis=1).any():
        raise InputError("has no child", place=f"tree: node {int(np.flatnonzero((count == ABSENT).all(axis=1))[0])}")
    parents = np.bincount(child[inner], minlength=n)
    if (parents > 1).any():
        raise InputError("is the child of two nodes or more", place=f"tree: node {int(np.argmax(parents > 1))}")
    if (parents[1:] == 0).any():
        raise InputError("is no node's child, and is not the root, node 0", place=f"tree: node {1 + int(np.argmax(parents[1:] == 0))}")
    reached = np.zeros(n, bool)
    reached[np.concatenate(tree.levels())] = True
    if not reached.all():
        raise InputError("is part of a cycle, which the root does not reach", place=f"tree: node {int(np.argmin(reached))}")


def check_primitives(tree: BoxTree, n: int, spatial_splits: bool) -> None:
    """Raise InputError unless the leaves hold each of n primitives, once unless `spatial_splits`."""
    leaf, size = tree.count > 0, len(tree.primitives)
    require(~leaf | ((tree.child >= 0) & (tree.child + tree.count <= size)), f"the leaf leaves `primitives`, which has {size}", tree.child)
    wrong = (tree.primitives < 0) | (tree.primitives >= n)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise InputError(f"must be a prim_id, 0 to {n - 1}, got {tree.primitives[i]}", place=f"tree: primitives[{i}]")
    first, count = tree.child[leaf], tree.count[leaf]
    uses = np.zeros(size + 1, np.int64)
    np.add.at(uses, first, 1)
    np.add.at(uses, first + count, -1)
    uses = np.cumsum(uses)[:size]
    if (uses > 1).any():
        raise InputError("is in two leaves", place=f"tree: primitives[{int(np.argmax(uses > 1))}]")
    if (uses < 1).any():
        raise InputError("is in no leaf", place=f"tree: primitives[{int(np.argmax(uses < 1))}]")
    times = np.bincount(tree.primitives, minlength=n)
    if (times == 0).any():
        raise InputError("is in no leaf", place=f"tree: primitive {int(np.argmax(times == 0))}")
    if (times > 1).any() and not spatial_splits:
        raise InputError(f"is in the leaves {times.max()} times", place=f"tree: primitive {int(np.argmax(times > 1))}",
                         hint="pass spatial_splits=True if the builder splits primitives")


def check_boxes(tree: BoxTree, geometry: Geometry, spatial_splits: bool) -> None:
    """Raise InputError unless each box contains the boxes of its children, or the primitives of its leaf."""
    exists, leaf, inner = tree.count != ABSENT, tree.count > 0, tree.count == INNER
    nan = np.isnan(tree.lo).any(axis=2) | np.isnan(tree.hi).any(axis=2)
    require(~exists | ~nan, "the box has a NaN")
    require(~exists | (tree.lo <= tree.hi).all(axis=2), "the box is empty: lo is above hi")
    low = np.where(exists[..., None], tree.lo, np.inf).min(axis=1)
    high = np.where(exists[..., None], tree.hi, -np.inf).max(axis=1)
    at = np.where(inner, tree.child, 0)
    fits = ((tree.lo <= low[at]) & (tree.hi >= high[at])).all(axis=2)
    require(~inner | fits, "the box does not contain the boxes of its node's children")
    lo, hi = geometry.bounds() if spatial_splits else bare_bounds(geometry)
    low, high = leaf_bounds(tree, lo, hi)
    if spatial_splits:
        held = (tree.lo <= high).all(axis=2) & (tree.hi >= low).all(axis=2)
        require(~leaf | held, "the box of the leaf does not meet its primitives")
    else:
        require(~leaf | ((tree.lo <= low) & (tree.hi >= high)).all(axis=2), "the box of the leaf does not contain its primitives")


def bare_bounds(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of every primitive without padding: low and high, (N, 3) float32."""
    corners, spheres = geometry.vertices[geometry.faces], geometry.spheres
    return (np.concatenate([corners.min(axis=1), spheres[:, :3] - spheres[:, 3:]]),
            np.concatenate([corners.max(axis=1), spheres[:, :3] + spheres[:, 3:]]))


def leaf_bounds(tree: BoxTree, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box around the primitives of each leaf, (N, W, 3) each; empty where there is no leaf. lo, hi: of all primitives."""
    leaf = tree.count > 0
    low, high = np.full(tree.lo.shape, np.inf, np.float32), np.full(tree.lo.shape, -np.inf, np.float32)
    owner = np.repeat(np.flatnonzero(leaf.reshape(-1)), tree.count[leaf])
    count = tree.count[leaf]
    within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    prim_id = tree.primitives[np.repeat(tree.child[leaf], count) + within]
    np.minimum.at(low.reshape(-1, 3), owner, lo[prim_id])
    np.maximum.at(high.reshape(-1, 3), owner, hi[prim_id])
    return low, high


def grown(tree: BoxTree, geometry: Geometry) -> BoxTree:
    """Return the tree with boxes that also contain the padded boxes of the primitives, so that rounding loses no ray."""
    low, high = leaf_bounds(tree, *geometry.bounds())
    return nested(replace(tree, lo=np.minimum(tree.lo, low), hi=np.maximum(tree.hi, high)))


def nested(tree: BoxTree) -> BoxTree:
    """Return the tree with boxes that contain the boxes of their node's children. Boxes rounded to few bits may not."""
    lo, hi, inner = tree.lo.copy(), tree.hi.copy(), tree.count == INNER
    for level in reversed(tree.levels()):
        at = np.where(inner[level], tree.child[level], 0)
        mask = inner[level][..., None]
        lo[level] = np.where(mask, np.minimum(lo[level], lo[at].min(axis=2)), lo[level])
        hi[level] = np.where(mask, np.maximum(hi[level], hi[at].max(axis=2)), hi[level])
    return replace(tree, lo=lo, hi=hi)


def end_point_overlap(tree: BoxTree, geometry: Geometry, threads: int) -> float:
    """Compute the end-point overlap of a BVH, at cost 1 per node and 1 per primitive; 0 without any area.

    The source is Aila, Karras and Laine 2013, "On Quality Metrics of Bounding Volume Hierarchies", equation 2. It sums over all nodes:
    cost times the fraction of the surface that is in the node's box, but not in its subtree. Only finite triangles have surface. A
    triangle with several references is in several subtrees.
    """
    from wrt.kernels.build import end_point_overlap as kernels  # not at the top, because a start does not need it

    cpu, n = start("cpu"), len(geometry.faces)
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    finite = np.isfinite(corners).all(axis=(1, 2))
    corners = corners[finite]
    surface = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    if not surface > 0.0:
        return 0.0
    of_tree = kernels.Children()
    of_tree.width = tree.width
    of_tree.lo, of_tree.hi = (upload(array.reshape(-1, 3), wp.vec3, cpu) for array in (tree.lo, tree.hi))
    of_tree.first, of_tree.count, of_tree.order = (upload(array.reshape(-1), wp.int32, cpu)
                                                   for array in (tree.child, tree.count, tree.primitives))
    vertices, faces = upload(geometry.vertices, wp.vec3, cpu), upload(geometry.faces, wp.vec3i, cpu)
    out = wp.zeros(n, dtype=wp.float64, device=cpu)
    launch(kernels.end_point_overlap, n, of_tree, vertices, faces, None, out, threads=threads, step=TRIANGLES_PER_LAUNCH)
    return float(out.numpy()[finite].sum() / surface)
