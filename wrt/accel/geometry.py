"""Triangles and spheres that a structure is built over, the records of triangle tests, and instances of meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial

import numpy as np
import warp as wp

from wrt.core.arrays import to_numpy
from wrt.core.device import records, upload
from wrt.core.files import checksum_of
from wrt.core.threads import run_all
from wrt.core.types import Device, WarpArray, WarpStruct
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.scene.clean import corners_have_area
from wrt.scene.mesh import Mesh

RECORDS_PER_JOB = 32768
# Largest row sum of |A| |A^-1|, the growth of rounding errors from a mesh's own space to world space by the matrix A. Rotation and
# scaling have at most 3.
MAX_SPREAD = 1e4
MESH_OF_A_SPHERE = "wrt.scene.shapes.icosphere makes a mesh of a sphere"  # hint of errors about spheres


def corners(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the corners to the records. A triangle without area gets NaN for v0, so that no ray hits it.

    Collinearity is decided here in exact arithmetic, because a query in float64 could not decide it.
    """
    record["v0"], record["v1"], record["v2"] = v0, v1, v2
    record["v0"][~corners_have_area(v0, v1, v2)] = np.nan


def edges(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the corner v0 and the edges v1 - v0 and v2 - v0, rounded to float32, to the records."""
    with np.errstate(over="ignore"):
        record["v0"], record["v1"], record["v2"] = v0, v1 - v0, v2 - v0


def transform(record: np.ndarray, v0: np.ndarray, v1: np.ndarray, v2: np.ndarray) -> None:
    """Write the affine map from world space to the unit triangle, computed in float64: row a gives u, row b gives v, row c the height.

    The third axis is the unit normal, so that c is the triangle's plane. A triangle without area gets zeros, so that no ray hits it.
    """
    p = v0.astype(np.float64)
    e1, e2 = v1 - p, v2 - p
    normal = np.cross(e1, e2)
    area2 = (normal * normal).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        rows = {"a": np.cross(e2, normal) / area2, "b": np.cross(normal, e1) / area2, "c": normal / np.sqrt(area2)}
        for name, row in rows.items():
            row = np.concatenate([row, -(row * p).sum(axis=1, keepdims=True)], axis=1).astype(np.float32)
            record[name] = np.where(np.isfinite(row).all(axis=1, keepdims=True), row, np.float32(0.0))


# A function for each layout in kernels.units.triangle.RAY_TRIANGLE.
Layout = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]
LAYOUTS: dict[str, Layout] = {"corners": corners, "edges": edges, "transform": transform}


@dataclass(frozen=True, eq=False)
class Geometry:
    """Triangles and spheres: vertices (V, 3) float32, faces (F, 3) int32, spheres (S, 4) float32 (center, radius).

    prim_ids number the faces first, then the spheres. origin: (3,) float64, the point that is 0 in these arrays; None: 0.
    """

    vertices: np.ndarray
    faces: np.ndarray
    spheres: np.ndarray
    origin: np.ndarray | None = None

    @staticmethod
    def of(mesh: Mesh) -> Geometry:
        """Make the geometry of a mesh, without spheres."""
        return Geometry(mesh.vertices, mesh.faces, np.zeros((0, 4), np.float32), mesh.origin)

    def __len__(self) -> int:
        return len(self.faces) + len(self.spheres)

    @property
    def n_triangles(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    def checksum(self) -> str:
        """Return `checksum_of` the arrays, in hexadecimal."""
        return f"{checksum_of(self.vertices, self.faces, self.spheres, *([] if self.origin is None else [self.origin])):08x}"

    def on(self, device: Device, faces: WarpArray | None = None) -> WarpStruct:
        """Upload to a device, as kernels.build.shape.Shape. faces: the faces, if they are on the device already."""
        from wrt.kernels.build.shape import Shape  # not at the top: starts that build few primitives do not need it

        shape = Shape()
        shape.vertices = upload(self.vertices, wp.vec3, device, read_only=True)
        shape.faces = upload(self.faces, wp.vec3i, device, read_only=True) if faces is None else faces
        shape.spheres = upload(self.spheres, wp.vec4, device, read_only=True)
        return shape

    def bounds(self, threads: int = 1, out: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Compute the padded box of every primitive: low and high, (N, 3) float32, into `out` if given.

        The boxes have the same bits as in the intersection tests (kernels.units.triangle.within_bounds), so that no hit is outside
        its box. The box of a triangle with a corner that is not finite is all of space, as in kernels.build.shape.
        """
        lo, hi = out or (np.empty((len(self), 3), np.float32) for _ in range(2))

        def fill(first: int) -> None:
            some, n = slice(first, first + RECORDS_PER_JOB), len(self.faces)
            corners = [self.vertices.take(self.faces[some, i], axis=0) for i in range(3)]
            spheres = self.spheres[max(first - n, 0) : max(first + RECORDS_PER_JOB - n, 0)]
            low, high = (np.concatenate([end(end(corners[0], corners[1]), corners[2]), spheres[:, :3] + sign * spheres[:, 3:]])
                         for end, sign in ((np.minimum, np.float32(-1.0)), (np.maximum, np.float32(1.0))))
            with np.errstate(over="ignore", invalid="ignore"):  # if coordinates overflow, the padded box is all of space
                x, y, z = (high - low).T
                pad = np.float32(PAD_EXTENT) * np.maximum(np.maximum(x, y), z)[:, None] + np.float32(PAD_SMALLEST)
                lo[some] = low - (pad + np.float32(PAD_COORDINATE) * np.abs(low))
                hi[some] = high + (pad + np.float32(PAD_COORDINATE) * np.abs(high))
            if not np.isfinite(pad.max(initial=0.0)):
                nowhere = np.isnan(lo[some]).any(axis=1) | np.isnan(hi[some]).any(axis=1)
                lo[some][nowhere], hi[some][nowhere] = -np.inf, np.inf

        run_all([partial(fill, first) for first in range(0, len(self), RECORDS_PER_JOB)], threads)
        return lo, hi

    def primitives(self, units: Units, order: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
        """Return the records that the triangle test of `units` reads: one for each prim_id in `order`; None: for each primitive."""
        if order is not None and len(order) > len(self):  # make each record once
            return self.primitives(units, None, threads)[order]
        prim_id = np.arange(len(self), dtype=np.int32) if order is None else order
        out = records(units.triangle_test.record, len(prim_id))
        out["prim_id"] = prim_id

        def fill(first: int) -> None:
            some = slice(first, first + RECORDS_PER_JOB)
            triangle = prim_id[some] < len(self.faces) if units.spheres else slice(None)
            part = out[some][triangle]
            faces = self.faces.take(part["prim_id"], axis=0)
            LAYOUTS[units.triangle_test.layout](part, *(self.vertices.take(faces[:, i], axis=0) for i in range(3)))
            if units.spheres:
                out[some][triangle] = part

        run_all([partial(fill, first) for first in range(0, len(prim_id), RECORDS_PER_JOB)], threads)
        return out


@dataclass(frozen=True, eq=False)
class NumberedGeometry(Geometry):
    """A geometry with other prim_ids in the scene: primitive i has prim_ids[i]. prim_ids: (N,) int32, ascending."""

    prim_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))

    def primitives(self, units: Units, order: np.ndarray | None = None, threads: int = 1) -> np.ndarray:
        if order is not None and len(order) > len(self):
            return self.primitives(units, None, threads)[order]
        out = super().primitives(units, order, threads)
        out["prim_id"] = self.prim_ids[out["prim_id"]]
        return out


@dataclass(frozen=True, eq=False)
class InstancedGeometry:
    """Instances of geometries in world space. Spheres belong to part 0, and their prim_ids come after the triangles.

    `to_world` maps the arrays of a part, without the part's origin, to the world minus `origin`."""

    parts: tuple[Geometry, ...]  # In their own spaces; their prim_ids begin at 0.
    part: np.ndarray  # (I,) int, index of each instance's part.
    to_world: np.ndarray  # (I, 3, 4) float64, affine and invertible.
    first_prim: np.ndarray  # (I,) int, which an instance adds to the prim_ids of its part.
    n_triangles: int  # Number of triangles of all instances.
    worlds: np.ndarray | None = None  # (W + 1,) int. World w has the instances [worlds[w], worlds[w + 1]); None: one world.
    origin: np.ndarray | None = None  # (3,) float64, the point of the world that is 0 for the structure; None: 0.

    @property
    def first_instance(self) -> np.ndarray:
        """Index of the first instance of each world, and, as the last entry, the number of instances: (W + 1,) int64."""
        return np.array([0, len(self.part)] if self.worlds is None else self.worlds, np.int64)

    @property
    def n_worlds(self) -> int:
        """Number of worlds; 1 if the structure was not built from a list of worlds."""
        return 1 if self.worlds is None else len(self.worlds) - 1

    @property
    def world_first_prim(self) -> np.ndarray:
        """Index of each world's first primitive among the primitives of all worlds, (W,) int64."""
        if self.worlds is None:
            return np.zeros(1, np.int64)
        return np.append(self.first_prim, self.n_triangles)[self.worlds[:-1]]

    @property
    def first_prim_in_world(self) -> np.ndarray:
        """First prim_id of each instance, counted from the first primitive of its world, (I,) int64."""
        return self.first_prim - np.repeat(self.world_first_prim, np.diff(self.first_instance))

    @property
    def spheres(self) -> np.ndarray:
        """Spheres (S, 4) float32, as in Geometry. Spheres have no transforms."""
        return self.parts[0].spheres

    def __len__(self) -> int:
        return self.n_triangles + len(self.spheres)

    @property
    def is_placed(self) -> np.ndarray:
        """Mask of instances, (I,) bool: True for one object with its own transform, False for joined objects."""
        return np.array([not isinstance(part, NumberedGeometry) for part in self.parts], bool)[self.part]

    def now(self) -> InstancedGeometry:
        """Return the instances with the present matrices, which no move changes."""
        return InstancedGeometry(*(getattr(self, each.name) for each in fields(self)))

    def near_zero(self, rows: np.ndarray, matrices: np.ndarray) -> np.ndarray:
        """Convert matrices (R, 3, 4) of the instances `rows` from the caller's mesh and world to those of `to_world`."""
        origins = [part.origin for part in self.parts]
        if self.origin is None and all(each is None for each in origins):
            return matrices
        own = np.array([np.zeros(3) if each is None else each for each in origins])[self.part[rows]]
        out = matrices.copy()
        out[:, :, 3] += (matrices[:, :, :3] @ own[:, :, None])[..., 0] - (0.0 if self.origin is None else self.origin)
        return out


class MovedGeometry(InstancedGeometry):
    """Instances that move in place. places: Warp array (3 I,) of vec4d, the rows of the matrices."""

    places: WarpArray

    def __init__(self, geometry: InstancedGeometry, places: WarpArray) -> None:
        self.__dict__.update({**geometry.now().__dict__, "places": places})

    @property
    def to_world(self) -> np.ndarray:
        """Copy of the present matrices on the host."""
        return to_numpy(self.places).reshape(-1, 3, 4).copy()


def inverse_of(matrices: np.ndarray) -> np.ndarray:
    """Invert affine maps (I, 3, 4) in float64."""
    linear = np.linalg.inv(matrices[:, :, :3])
    return np.concatenate([linear, -(linear @ matrices[:, :, 3:])], axis=2)
