"""Closest hits with gradients for JAX: `wrt.jax.closest_hit`."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.gradients import Cotangents, adjoint
from wrt.accel.queries.rays import from_origin
from wrt.accel.tensors import HitTensors, at_vertices, hits_of
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.types import ArrayLike

if TYPE_CHECKING:
    from jax import Array


def closest_hit(accel: OneMesh, vertices: ArrayLike | None, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
                t_max: ArrayLike = np.inf, *, rebuild_at: float = 2.0) -> HitTensors[Array]:
    """Find the closest hit of each ray, with gradients, also in jax.jit, jax.grad and jax.vmap.

    A callback on the host queries the structure, which is a constant of the traced function. JAX wraps exceptions of the callback.

    Parameters
    ----------
    accel, vertices, origins, directions, t_min, t_max, rebuild_at
        See `wrt.torch.closest_hit`, with JAX arrays in place of tensors.

    Returns
    -------
    HitTensors
        JAX arrays.

    Raises
    ------
    InputError
        Names the argument and what was expected. Also raised if JAX is not installed.
    """
    with needed_by("wrt.jax"):
        import jax.numpy as jnp
    inputs = (jnp.asarray(each) for each in (() if vertices is None else (vertices,)) + (origins, directions))
    *points, o, d = (each.astype(np.float32) if each.dtype.kind in "iu" else each for each in inputs)
    if o.shape != d.shape or o.shape[1:] != (3,):
        raise InputError(f"and directions must both be (N, 3), got {o.shape} and {d.shape}", argument="origins")
    ends = (jnp.asarray(each, np.float32) for each in (t_min, t_max))
    return _function()(accel, rebuild_at, *points or [None], o, d, *ends)


@cache
def _function() -> Any:
    """Make the JAX function closest_hit(accel, rebuild_at, vertices or None, origins, directions, t_min, t_max) with its gradient."""
    import jax

    def on_host(function: Any, shapes: Any, *arrays: Any) -> Any:
        return jax.pure_callback(lambda *each: function(*jax.tree.map(np.asarray, each)), shapes, *arrays, vmap_method="sequential")

    def closest_hit(accel: OneMesh, rebuild_at: float, vertices: Any, *rays: Any) -> HitTensors:
        def query(vertices: Any, *rays: Any) -> HitTensors:
            hits = hits_of(accel, vertices, rays, rebuild_at)
            return HitTensors(hits.t, hits.u, hits.v, hits.point.astype(np.float32), hits.prim_id)

        n = len(rays[0])
        one, three, index = (jax.ShapeDtypeStruct(*each) for each in (((n,), np.float32), ((n, 3), np.float32), ((n,), np.int32)))
        return on_host(query, HitTensors(one, one, one, three, index), vertices, *rays)

    def forward(accel: OneMesh, rebuild_at: float, *inputs: Any) -> tuple[HitTensors, Any]:
        hits = closest_hit(accel, rebuild_at, *inputs)
        return hits, (*inputs, hits.prim_id)

    def backward(accel: OneMesh, rebuild_at: float, residuals: Any, cotangents: HitTensors) -> Any:
        vertices, origins, directions, *ends, prim_id = residuals
        inputs = vertices, origins, directions

        def gradients(inputs: Any, prim_id: Any, cotangents: Any) -> Any:
            vertices, origins, directions = inputs
            geometry = accel.geometry
            if vertices is not None:
                geometry = at_vertices(geometry, vertices)
            near = from_origin(origins.astype(np.float64), geometry.origin)
            found = adjoint(geometry, near, directions, prim_id, Cotangents(*cotangents))
            return tuple(x if x is None else each.astype(x.dtype) for each, x in zip(found, inputs, strict=True))

        shapes = jax.tree.map(lambda each: jax.ShapeDtypeStruct(each.shape, each.dtype), inputs)
        return *on_host(gradients, shapes, inputs, prim_id, cotangents[:4]), *map(jax.numpy.zeros_like, ends)

    function = jax.custom_vjp(closest_hit, nondiff_argnums=(0, 1))
    function.defvjp(forward, backward)
    return function
