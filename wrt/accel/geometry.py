"""Triangles and spheres that a structure is built over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from wrt.accel.triangle_data import LAYOUTS
from wrt.core.device import records, upload
from wrt.core.files import checksum_of
from wrt.core.threads import run_all
from wrt.core.types import Device, WarpArray, WarpStruct
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.scene.mesh import Mesh

RECORDS_PER_JOB = 32768
MESH_OF_A_SPHERE = "wrt.scene.shapes.icosphere makes a mesh of a sphere"  # hint of errors about spheres


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
