"""Wide BVHs: binary trees collapsed into nodes of 4 or 8 children."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar, Self

import numpy as np
import warp as wp

from wrt.accel.base import OneMesh
from wrt.accel.box_tree import ABSENT, INNER, BoxTree
from wrt.accel.bvh.builders import BinaryOptions, BinaryTree, BvhOptions, binary_tree_of, build_binary
from wrt.accel.bvh.compress import compress, decompress, existing_children
from wrt.accel.bvh.in_place import InPlaceBvh
from wrt.accel.bvh.refit import Fitting
from wrt.accel.bvh.top_down import build_few
from wrt.accel.bvh.wide_tree import (
    WideTree,
    check_wide,
    collapse,
    collapse_kernels,
    fit,
    fit_inputs,
    lanes_of,
    one_leaf,
    packed,
    refit,
    row_starts,
    wide_tree_of,
)
from wrt.accel.geometry import Geometry
from wrt.accel.queries.raw_launches import launch_raw
from wrt.accel.snapshot import Built
from wrt.core.building import report, report_parts
from wrt.core.device import aligned, empty_aligned, launch_on, preloading, record_dtype, start, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all
from wrt.core.types import Kernel, WarpStruct
from wrt.kernels.wide.layout import PLANES, STACK_SIZE, first_reference, node_size
from wrt.kernels.wide.references import EMPTY, MAX_FIRST, leaf_count, leaf_first
from wrt.kernels.wide.stream import BatchTraversal
from wrt.kernels.wide.traverse import WideTraversal

ROWS_PER_JOB = 4096
SMALL = 128  # primitives: so few trees are built in one launch, and without reinsertion, which gains nothing there
BINARY = 0.8  # share of a build's time after which the binary tree is finished, for large meshes
ROWS_BY_KERNEL = 1 << 15  # triangles


def rows_kernel() -> Kernel:
    """Return the kernel that writes rows of triangles. It is imported when it is needed."""
    from wrt.kernels.build.shape import write_rows

    return write_rows


@dataclass(frozen=True)
class Bvh4Options(BinaryOptions):
    """Options of wide BVHs: BinaryOptions, where cost_intersection is the SAH cost of a row of primitives, which are tested at once.

    max_leaf is by default the number of primitives in a row.
    """

    builder: str = "refined"


@dataclass(frozen=True)
class Bvh8Options(Bvh4Options):
    __doc__ = Bvh4Options.__doc__

    max_leaf: int = 8


class CollapsedBvh(OneMesh):
    """A binary tree collapsed into nodes of `width` children. Subclasses convert the tree to the arrays of their nodes, and back."""

    width: ClassVar[int]
    compressed: ClassVar[bool] = False
    can_refit = True

    @abstractmethod
    def _arrays(self, tree: WideTree) -> dict[str, np.ndarray]:
        """Return the nodes of a tree, as arrays of the structure's Warp struct."""

    @abstractmethod
    def _tree(self, built: Built) -> WideTree:
        """Convert arrays from `_arrays` back to a tree, and decode compressed boxes."""

    @classmethod
    def _of_binary(cls, options: BvhOptions) -> BvhOptions:
        """Return the options of the binary tree. Two leaves count as cheaper than one if they have less area, because the cost of inner
        nodes depends on the collapse."""
        return replace(options, max_leaf=min(options.max_leaf, cls.width), cost_traversal=0.0, cost_intersection=1.0)

    def _collapsed(self, options: BvhOptions, *kernels: Kernel, binary: BinaryTree | None = None) -> WideTree:
        """Build a binary tree, unless it is given, and collapse it; load `kernels`, which the structure needs afterwards, meanwhile."""
        with preloading(*(collapse_kernels() if len(self.geometry) > 1 else ()), *kernels):
            if binary is None:
                binary = build_binary(self.geometry, self._of_binary(options), self.threads)
            report(BINARY)
            if len(binary.order) < 2:
                return one_leaf(*self.geometry.bounds(), self.width)
            tree = collapse(binary, self.width, options.max_leaf, options.cost_traversal, options.cost_intersection)
        if self.compressed and len(binary.order) > MAX_FIRST:
            raise InputError(f"a {self.name} holds at most {MAX_FIRST} primitives, and there are {len(binary.order)}",
                             hint="use bvh8")
        return tree

    def _box_tree(self, built: Built) -> BoxTree:
        tree = self._tree(built)
        children = packed(tree.children, 1).astype(np.int64)
        leaf = children < 0
        count = np.where(leaf, leaf_count.func(children), np.where(children == EMPTY, ABSENT, INNER))
        return BoxTree(tree.lo, tree.hi, np.where(leaf, leaf_first.func(children), children).astype(np.int32), count.astype(np.int32),
                       built.order)

    def _arranged(self, tree: WideTree) -> WideTree:
        """Order a tree as `_arrays` needs it, or raise InputError if the nodes cannot hold it."""
        return tree

    def _built_of(self, tree: BoxTree) -> Built:
        """Convert a tree. Binary trees as of a builder of wrt are collapsed into nodes of more children."""
        whole = tree.width == 2 and len(tree.primitives) > 1 and (tree.count != ABSENT).all()
        if whole and len(tree.levels()) <= STACK_SIZE:  # `collapse` has stacks for such trees
            options = BvhOptions(**{"max_leaf": 1} | asdict(self.options()) | {"row": self.width})
            wide = collapse(binary_tree_of(tree), self.width, options.max_leaf, options.cost_traversal, options.cost_intersection)
        else:
            wide = wide_tree_of(tree, self.width)
        wide = self._arranged(wide)
        built = Built(self._arrays(wide), wide.order[wide.order >= 0], len(wide.children), wide.leaves, wide.depth)
        return replace(built, sah_cost=self._tree(built).sah_cost(wide.root_area))

    def _refit(self, built: Built) -> Built:
        built = built.on_host()
        tree = refit(self._tree(built), self.geometry, self.threads)
        built = replace(built, arrays=self._arrays(tree))
        return replace(built, sah_cost=self._tree(built).sah_cost(tree.root_area))


class WideBvh(InPlaceBvh, CollapsedBvh):
    """A binary tree collapsed into nodes of `width` children. Options: Bvh4Options and Bvh8Options."""

    def _build(self, options: BinaryOptions) -> Built:
        return self.build_all([self], options)[0]

    @classmethod
    def build_all(cls, structures: Sequence[Self], options: BinaryOptions) -> list[Built]:
        options = BvhOptions(**asdict(options), row=cls.width)
        few = [each for each in structures if options.builder == "refined" and 2 <= len(each.geometry) <= SMALL]
        with preloading(*collapse_kernels() if few else ()):
            binary = build_few([each.geometry.bounds() for each in few], cls._of_binary(options))
        trees = dict(zip(map(id, few), binary, strict=True))
        return report_parts(structures, lambda each: each._built(trees.get(id(each)), options))

    def _built(self, binary: BinaryTree | None, options: BvhOptions) -> Built:
        """Return the arrays of the tree over a binary tree, which is built if it is None."""
        tree = self._collapsed(options, *([rows_kernel()] if self._rows_by_kernel() else []), binary=binary)
        built = Built(self._arrays(tree), tree.order[tree.order >= 0], len(tree.children), tree.leaves, tree.depth)
        return replace(built, sah_cost=(self._tree(built) if self.compressed else tree).sah_cost(tree.root_area))

    def _nodes(self, built: Built) -> np.ndarray:
        return built.arrays["nodes"].reshape(-1, node_size(self.width, self.compressed))

    def _references(self, built: Built) -> np.ndarray:
        """Return the references to all children, (N, width) int32."""
        first = first_reference(self.width, self.compressed)
        return np.ascontiguousarray(self._nodes(built)[:, first : first + self.width]).view(np.int32)

    def _arrays(self, tree: WideTree) -> dict[str, np.ndarray]:
        """Return the nodes in the layout of kernels.wide.nodes, as one array of floats."""
        n, size, first = len(tree.children), node_size(self.width, self.compressed), first_reference(self.width, self.compressed)
        nodes = empty_aligned((n, size), np.float32)
        nodes[:, first : first + self.width], nodes[:, first + self.width :] = tree.children.view(np.float32), 0.0
        if self.compressed:
            nodes[:, first : first + self.width] = packed(tree.children, 1).view(np.float32)
            nodes[:, :first] = compress(tree.lo, tree.hi, tree.children != EMPTY)
        else:
            planes = nodes[:, :first].reshape(n, len(PLANES), self.width)
            planes[:, 0::2], planes[:, 1::2] = tree.lo.transpose(0, 2, 1), tree.hi.transpose(0, 2, 1)
        return {"nodes": nodes.reshape(-1)}

    def _tree(self, built: Built) -> WideTree:
        head = self._nodes(built)[:, : first_reference(self.width, self.compressed)]
        if self.compressed:
            lo, hi = decompress(head, self.width)
        else:
            planes = head.reshape(-1, len(PLANES), self.width)
            lo, hi = (np.ascontiguousarray(planes[:, end::2].transpose(0, 2, 1)) for end in range(2))
        children = packed(self._references(built), self.width)
        return WideTree(lo, hi, children, lanes_of(children, built.order, self.width), built.leaves, built.depth)

    def _starts(self, built: Built) -> np.ndarray:
        """Return the index in the order of each row's first primitive and, last, the number of primitives, (rows + 1,) int32."""
        count, width = len(built.order), self.width
        if self.compressed:
            return np.minimum(np.arange(0, count + width, width, dtype=np.int32), count)
        return row_starts(self._references(built), width)

    def _primitives(self, built: Built) -> np.ndarray:
        """Return the records of the triangle test in rows of `width` lanes; an unused lane repeats the primitive before it."""
        built = built.on_host()
        units, width, order, starts = self.structure.units, self.width, built.order, self._starts(built)
        floats = record_dtype(units.triangle_test.record).itemsize // 4
        rows = empty_aligned((len(starts) - 1, floats, width), np.float32)
        if self._rows_by_kernel():
            launch_raw(rows_kernel(), len(rows), self.geometry.on(start("cpu")), order, starts, width, rows.reshape(-1), None,
                       threads=self.threads, step=4 * ROWS_PER_JOB)
            return rows.reshape(-1)

        def fill(first: int) -> None:
            begin = starts[first : first + ROWS_PER_JOB + 1, None]
            lanes = order[np.minimum(begin[:-1] + np.arange(width, dtype=np.int32), begin[1:] - 1)]
            records = self.geometry.primitives(units, lanes.reshape(-1)).view(np.float32).reshape(*lanes.shape, floats)
            rows[first : first + ROWS_PER_JOB] = records.transpose(0, 2, 1)

        run_all([partial(fill, first) for first in range(0, len(rows), ROWS_PER_JOB)], self.threads)
        return rows.reshape(-1)

    def _rows_by_kernel(self) -> bool:
        """Return True if a kernel writes the rows: from so many triangles on that this saves more time than loading the kernel takes."""
        return (self.structure.units.triangle_test.layout == "corners" and type(self.geometry) is Geometry
                and self.geometry.n_triangles >= ROWS_BY_KERNEL)

    def _upload(self, built: Built) -> WarpStruct:
        nodes = built.arrays["nodes"]
        return super()._upload(built if isinstance(nodes, wp.array) else replace(built, arrays={"nodes": aligned(nodes)}))

    def _in_place(self, built: Built, shape: WarpStruct) -> tuple[WarpStruct, Callable[[], None]]:
        host, data = built.on_host(), self.data
        references, starts, fitting = self._references(host), self._starts(host), Fitting(self.device, len(self.geometry), 0)
        tree = fit_inputs(references, built.order, starts, fitting)
        tree.nodes = tree.boxes = data.nodes
        if self.compressed:
            boxes = np.tile(np.array([np.inf, -np.inf] * 3, np.float32)[:, None], (len(references), 1, self.width))
            tree.boxes = upload(boxes.reshape(-1), wp.float32, self.device)

        def run() -> None:
            fitting.find_bounds(shape, self.threads)
            fit(tree, self.width, self.compressed, self.threads)
            if len(shape.faces):  # records of spheres do not change
                launch_on(self.device, rows_kernel(), len(starts) - 1, shape, tree.order, tree.starts, self.width, data.primitives, None,
                          threads=self.threads, step=4 * ROWS_PER_JOB, captured=True)

        return tree, run

    def _check(self, built: Built) -> None:
        if len(built.arrays["nodes"]) % node_size(self.width, self.compressed):
            raise InputError("is damaged: its last node is incomplete")
        references = self._references(built)
        check_wide(references, len(built.order), 1 if self.compressed else self.width)
        if self.compressed and (existing_children(self._nodes(built), self.width) != (references != EMPTY)).any():
            raise InputError("is damaged: a node's mask of children differs from its references")
        if not self.compressed:
            missing = np.flatnonzero(references == EMPTY)
            low = missing + missing // self.width * (node_size(self.width, False) - self.width)  # place of the child's first plane
            for k in range(len(PLANES)):
                if (built.arrays["nodes"].take(low + k * self.width) != (-np.inf if k % 2 else np.inf)).any():
                    raise InputError("is damaged: a child that does not exist has a box")


class Bvh4(WideBvh):
    __doc__ = WideBvh.__doc__

    name = "bvh4"
    options = Bvh4Options
    width = 4
    kernels = WideTraversal(4)


class Bvh8(WideBvh):
    __doc__ = WideBvh.__doc__

    name = "bvh8"
    options = Bvh8Options
    width = 8
    kernels = stream = BatchTraversal()


class Bvh8c(WideBvh):
    """bvh8 in less memory: 8 bits per plane, rounded outwards, and leaves without gaps (Ylitie, Karras and Laine 2017)."""

    name = "bvh8c"
    options = Bvh8Options
    width = 8
    compressed = True
    kernels = WideTraversal(8, compressed=True)
