"""Exchange of trees with other builders: what structures over one mesh have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Self

from wrt.accel.box_tree import BoxTree, nested
from wrt.accel.built import Built
from wrt.accel.flat_scene import FlatScene
from wrt.accel.geometry import Geometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.structure import Structure
from wrt.core.building import build_clock
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.kernels.traverse.common import Units


class TreeExchange(Accelerator):
    """Methods of OneMesh that give its tree away and take another builder's. BVHs implement `_box_tree` and `_built_of`."""

    name: ClassVar[str]
    options: ClassVar[type[Any]]
    built_with: Any  # an instance of `options`

    @property
    @abstractmethod
    def built(self) -> Built:
        """Result of the builder or of the last refit, in NumPy arrays."""

    @abstractmethod
    def _check(self, built: Built) -> None:
        """Raise InputError if arrays would lead a ray out of bounds or into a cycle."""

    @abstractmethod
    def _install(self, built: Built, begin: float, built_cost: float) -> None:
        """Upload the arrays and set the snapshot."""

    @classmethod
    def from_tree(cls, tree: BoxTree, geometry: Geometry, attributes: FlatScene | None = None, /, device: str = DEFAULT_DEVICE,
                  threads: int | None = None, *, spatial_splits: bool = False) -> Self:
        """Make a structure from another builder's tree, as wrt.accel_from_tree does.

        Raises InputError if the tree is not a tree over the geometry, or the structure cannot hold it.
        """
        self = cls.__new__(cls)
        Accelerator.__init__(self, Structure(cls, Units()), geometry, attributes, device, threads)
        self.built_with = cls.options()
        begin = build_clock()
        built = self._built_of(tree.checked(geometry, spatial_splits))
        self._check(built)
        self._install(built, begin, built.sah_cost)
        return self

    def tree(self) -> BoxTree:
        """Return the tree of a BVH as plain arrays, the same for all BVHs; `wrt.accel_from_tree` takes it back.

        Returns
        -------
        BoxTree
            Boxes, children and primitives of the nodes. `tree().save("tree.npz")` writes a file that NumPy reads. Spheres and 14-DOPs
            appear as boxes, and boxes of few bits as boxes that contain their children's.

        Raises
        ------
        InputError
            If the structure is not a BVH.
        """
        return nested(self._box_tree(self.built))

    def _box_tree(self, built: Built) -> BoxTree:
        raise InputError(f"a {self.name} has no tree of boxes", hint="use a BVH")

    def _built_of(self, tree: BoxTree) -> Built:
        """Convert a tree, whose boxes contain the padded primitives."""
        raise InputError(f"a {self.name} cannot be made from a tree of boxes", argument="accel", hint="use a BVH")
