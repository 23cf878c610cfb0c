"""The triangles and spheres that a structure is built over."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.triangle_data import LAYOUTS
from wrt.core.device import records, upload
from wrt.core.threads import run_all
from wrt.kernels.build.shape import Shape
from wrt.kernels.traverse.common import Units
from wrt.kernels.units.box import PAD_COORDINATE, PAD_EXTENT, PAD_SMALLEST
from wrt.scene.mesh import Mesh

RECORDS_PER_JOB = 32768


@dataclass(frozen=True, eq=False)
class Geometry:
    """What is hit, in world space: vertices (V, 3) float32, faces (F, 3) int32, spheres (S, 4) float32 (center, radius).

    prim_id counts the faces first, then the spheres.
    """

    vertices: np.ndarray
    faces: np.ndarray
    spheres: np.ndarray

    @staticmethod
    def of(mesh: Mesh) -> Geometry:
        """Of a mesh alone; prim_ids are indices into its faces."""
        return Geometry(mesh.vertices, mesh.faces, np.zeros((0, 4), np.float32))

    def __len__(self) -> int:
        return len(self.faces) + len(self.spheres)

    @property
    def n_triangles(self) -> int:
        """How many of the primitives are triangles: they come before the spheres."""
        return len(self.faces)

    @property
    def n_vertices(self) -> int:
        """How many vertices there are."""
        return len(self.vertices)

    def digest(self) -> str:
        """SHA-256 of the arrays: the same for the same geometry, whatever file it came from."""
        out = sha256()
        for array in (self.vertices, self.faces, self.spheres):
            out.update(f"{array.shape}{array.dtype.str}".encode() + np.ascontiguousarray(array).tobytes())
        return out.hexdigest()

    def on(self, device: Any, faces: Any = None) -> Any:
        """The same on a device (a Warp device): kernels.build.shape.Shape. faces: those that are there already."""
        shape = Shape()
        shape.vertices = upload(self.vertices, wp.vec3, device)
        shape.faces = upload(self.faces, wp.vec3i, device) if faces is None else faces
        shape.spheres = upload(self.spheres, wp.vec4, device)
        return shape

    def kept(self) -> Geometry:
        """What a structure goes on using: with nothing that others write to."""
        return self

    def bounds(self, threads: int = 1, out: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of every primitive's padded box, two (N, 3) float32; out: arrays that take them.

        To the last bit what the units take (kernels.units.triangle.within_bounds): a hit is never outside its box. Around a
        triangle with a corner that is not finite, all of space, as kernels.build.shape has it.
        """
        lo, hi = out or (np.empty((len(self), 3), np.float32) for _ in range(2))

        def fill(first: int) -> None:
            some, n = slice(first, first + RECORDS_PER_JOB), len(self.faces)
            corners = [self.vertices.take(self.faces[some, i], axis=0) for i in range(3)]
            spheres = self.spheres[max(first - n, 0) : max(first + RECORDS_PER_JOB - n, 0)]
            low, high = (np.concatenate([end(end(corners[0], corners[1]), corners[2]), spheres[:, :3] + sign * spheres[:, 3:]])
                         for end, sign in ((np.minimum, np.float32(-1.0)), (np.maximum, np.float32(1.0))))
            with np.errstate(over="ignore", invalid="ignore"):  # near the end of float32 the padded box is all of space
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
        """What the triangle test of `units` reads, in the given order of prim_id, or in their own."""
        if order is not None and len(order) > len(self):  # what stands more than once is made once
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
