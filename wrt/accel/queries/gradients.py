"""Gradients of closest hits in closed form, shared by NumPy, wp.Tape, PyTorch and JAX."""

from functools import partial
from typing import Any, Generic, NamedTuple

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.core.arrays import check_no_gradients, float32, to_numpy
from wrt.core.checks import shown
from wrt.core.errors import InputError
from wrt.core.threads import run_all, thread_count
from wrt.core.types import Array, ArrayLike, ArrayT
from wrt.core.warp_private import recording_tape

ONE_MESH = "only hits of a structure over one mesh, without spheres, have gradients"
HITS_PER_JOB = 8192  # few enough that the intermediate arrays stay in the cache


class Gradients(NamedTuple, Generic[ArrayT]):
    """Gradient of a loss with respect to the inputs of a query.

    Attributes
    ----------
    vertices : (V, 3) float64
        Gradient with respect to the vertices of the mesh.
    origins, directions : (N, 3) float64
        Gradient with respect to the rays; 0 for rays that missed.
    """

    vertices: ArrayT
    origins: ArrayT
    directions: ArrayT


class Cotangents(NamedTuple):
    """Gradient of a loss with respect to N hits. t, u, v: (N,); point: (N, 3); None: the loss does not depend on that field."""

    t: ArrayLike | None = None
    u: ArrayLike | None = None
    v: ArrayLike | None = None
    point: ArrayLike | None = None

    def checked(self, shape: tuple[int, ...]) -> "Cotangents":
        """Convert the fields, of the rays' shape, to NumPy arrays (N,) and (N, 3). Raises InputError for other shapes."""
        arrays = [field if field is None else to_numpy(field) for field in self]
        for i, (name, array) in enumerate(zip(self._fields, arrays, strict=True)):
            rest = (3,) if name == "point" else ()
            if array is not None:
                if array.shape != shape + rest or array.dtype.kind not in "iuf":
                    raise InputError(f"must be {shape + rest} of real numbers, got {shown(array)}", argument=name)
                arrays[i] = array.reshape(-1, *rest) if array.ndim != len(rest) + 1 else array
        return Cotangents(*arrays)

    def at(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the gradients with respect to (t, u, v) and to the point for the rays with indices `rays`: (3, len(rays)) float64 each."""
        by_tuv = np.zeros((3, len(rays)))
        for target, field in zip(by_tuv, self[:3], strict=True):
            target[:] = 0.0 if field is None else np.asarray(field)[rays]
        return by_tuv, np.zeros((3, 1)) if self.point is None else columns(np.asarray(self.point)[rays])


def adjoint(geometry: Geometry, origins: Array, directions: Array, prim_id: Array, cotangents: Cotangents,
            threads: int | None = None) -> Gradients:
    """Compute the gradient of a loss L with respect to vertices, origins and directions, at fixed prim_id.

    cotangents: gradient of L with respect to the hits. A hit solves o + t d = (1 - u - v) v0 + u v1 + v v2. With the matrix
    M = [d, v0 - v1, v0 - v2] this is M (t, u, v) = v0 - o. If an input moves v0 - o - M (t, u, v) by x, (t, u, v) moves by M^-1 x.
    So one vector per ray is enough: lambda = M^-T (dL/dt, dL/du, dL/dv). The corners get lambda times their barycentric weights,
    the origin -lambda, the direction -t lambda. A gradient with respect to the point adds terms, through point = o + t d.

    All values are float64. The sum at a vertex runs in the order of the rays, so that its bits do not depend on threads. The gradient
    is 0 for misses and if M is singular in float64. It grows as 1 / cos of the angle between ray and normal.
    """
    prim_id, o, d = to_numpy(prim_id), float32(to_numpy(origins)), float32(to_numpy(directions))  # float32, as in the query
    by_hits, prim_id = cotangents.checked(prim_id.shape), prim_id.reshape(-1)
    vertices, faces, n = geometry.vertices, geometry.faces, len(prim_id)
    out = Gradients(np.zeros((len(vertices), 3)), np.zeros((n, 3)), np.zeros((n, 3)))
    rows = np.flatnonzero((prim_id >= 0) & (prim_id < len(faces)))
    corners = faces[prim_id[rows]]
    by_corner = np.empty((3, len(rows), 3))

    def work(first: int) -> None:
        some = slice(first, first + HITS_PER_JOB)
        ray = rows[some]
        way, place = columns(d[ray]), columns(o[ray])
        by_tuv, by_point = by_hits.at(ray)
        v0, v1, v2 = (columns(vertices[corners[some, i]]) for i in range(3))
        inverse, exists = inverse_rows(way, v1 - v0, v2 - v0)
        t, u, v = (inverse * (v0 - place)).sum(axis=1)
        by_tuv[0] += (by_point * way).sum(axis=0)
        at_hit = (inverse * by_tuv[:, None]).sum(axis=0)  # lambda in the docstring
        at_origin = np.where(exists, by_point - at_hit, 0.0)
        out.origins[ray], out.directions[ray] = at_origin.T, (t * at_origin).T
        for axis in range(3):
            by_corner[axis, some] = np.stack([(1.0 - u - v) * at_hit[axis], u * at_hit[axis], v * at_hit[axis]], axis=1)

    run_all([partial(work, first) for first in range(0, len(rows), HITS_PER_JOB)], thread_count(threads))
    for axis in range(3):
        out.vertices[:, axis] = np.bincount(corners.reshape(-1), by_corner[axis].reshape(-1), len(vertices))
    return out


def record(hits: Any, **outputs: Any) -> None:
    """Register the backward pass of hits on the recording wp.Tape. outputs: arrays of the hits by their names in Cotangents.

    Gradients flow to origins, directions and the vertices of the last refit, if these require gradients.
    """
    (snapshot, rays, _), tape = hits.source, recording_tape()
    leaves: Gradients[Any] = Gradients(snapshot.followed, rays.origins, rays.directions)
    wanted = [array for array in leaves if isinstance(array, wp.array) and array.requires_grad and array.size]
    if tape is None or not wanted:
        return
    snapshot.structure.require_one_mesh(ONE_MESH)
    if not rays.as_warp:
        raise InputError("a wp.Tape is recording gradients of vertices: pass rays as Warp arrays, or query outside of the tape")
    for array in outputs.values():
        array.requires_grad = True

    def backward() -> None:
        found = hits.gradients(**{name: array.grad for name, array in outputs.items()})
        for array, values in zip(leaves, found, strict=True):
            if any(array is each for each in wanted):
                array.grad.assign(np.float32(array.grad.numpy() + values))

    tape.record_func(backward, [*wanted, *outputs.values()])


def check_recorded(hits: Any, name: str) -> None:
    """Raise InputError if the recording tape would need gradients of hits.`name`, which has none."""
    if hits.source is None:
        return
    snapshot, rays, _ = hits.source
    check_no_gradients(f"hits.{name}", vertices=snapshot.followed, origins=rays.origins, directions=rays.directions)


def columns(rows: np.ndarray) -> np.ndarray:
    """Transpose (N, 3) to (3, N) float64."""
    return np.ascontiguousarray(rows.T, np.float64)


def inverse_rows(d: np.ndarray, e1: np.ndarray, e2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return M^-1 for M = [d, -e1, -e2], (row, column, N), 0 where M is singular, and the mask (N,) of invertible M."""
    adjugate = np.stack([_cross(e1, e2), _cross(d, e2), _cross(e1, d)])
    with np.errstate(all="ignore"):
        inverse = adjugate / (d * adjugate[0]).sum(axis=0)
    exists = np.isfinite(inverse).all(axis=(0, 1))
    inverse[..., ~exists] = 0.0
    return inverse, exists


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of (3, N) arrays, faster than np.cross."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
