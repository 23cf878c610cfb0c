"""Closest hits with gradients for PyTorch: `wrt.torch.closest_hit`."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.gradients import Cotangents, adjoint
from wrt.accel.queries.rays import from_origin
from wrt.accel.snapshot import Snapshot
from wrt.accel.tensors import HitTensors, hits_of
from wrt.core.arrays import to_numpy
from wrt.core.packages import needed_by
from wrt.core.types import ArrayLike

if TYPE_CHECKING:
    from torch import Tensor


def closest_hit(accel: OneMesh, vertices: Tensor | None, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
                t_max: ArrayLike = np.inf, *, rebuild_at: float = 2.0) -> HitTensors[Tensor]:
    """Find the closest hit of each ray, with gradients of t, u, v and point at fixed prim_id.

    Gradients are computed in float64 on the CPU and have the same bits in every run. Gradients of misses are 0. There are no
    second derivatives (docs/gradients.md).

    Parameters
    ----------
    accel : OneMesh
        Structure over one mesh without spheres.
    vertices : (V, 3) tensor or None
        Vertices of the mesh. If they differ from the structure's vertices, the structure is refitted to them. None: no refit. The values
        of a tensor are read again only if its version has changed, which PyTorch counts: not after writes to its memory by NumPy, Warp or
        `.data`; pass a clone then.
    origins, directions, t_min, t_max
        See `Accelerator.closest_hit`; tensors on the CPU or a GPU, converted to float32.
    rebuild_at : float
        See `OneMesh.refit`.

    Returns
    -------
    HitTensors
        Tensors on the CPU, or on the GPU of `origins`.
    """
    with needed_by("wrt.torch"):
        import torch
    inputs = (each if each is None else torch.as_tensor(each) for each in (vertices, origins, directions))
    return HitTensors(*_function().apply(accel, rebuild_at, t_min, t_max, *inputs))


# By snapshot, the tensor of its vertices and that tensor's version. The tensor is kept, so that no other tensor gets its address.
_followed: WeakKeyDictionary[Snapshot, tuple[Tensor, int]] = WeakKeyDictionary()


def _has_vertices(snapshot: Snapshot, vertices: Tensor) -> bool:
    """Return whether the snapshot was made from these vertices, by their version."""
    if snapshot not in _followed or snapshot.changes or vertices.is_inference():
        return False
    (kept, version), same = _followed[snapshot], ("dtype", "device", "shape")
    return (vertices.data_ptr(), vertices.stride(), vertices._version) == (kept.data_ptr(), kept.stride(), version) and all(
        getattr(vertices, name) == getattr(kept, name) for name in same)


@cache
def _function() -> Any:  # a subclass of torch.autograd.Function
    import torch

    def as_it_is_on_cpu(each: Any) -> Any:  # far from 0, float64 counts
        return each if each.dtype == torch.float64 and each.device.type == "cpu" else each.float()

    def forward(ctx: Any, accel: OneMesh, rebuild_at: float, t_min: Any, t_max: Any, *inputs: Any) -> tuple[Any, ...]:
        vertices, *rays = (each if each is None else as_it_is_on_cpu(each).detach().contiguous() for each in inputs)
        known = vertices is None or (isinstance(accel, OneMesh) and _has_vertices(accel.snapshot, inputs[0]))
        hits = hits_of(accel, None if known else vertices, (*rays, t_min, t_max), rebuild_at)
        if vertices is not None and not inputs[0].is_inference():
            _followed[hits.source[0]] = inputs[0].detach(), inputs[0]._version  # type: ignore[index]
        ctx.geometry = hits.source[0].mesh  # type: ignore[index]
        ctx.input_types = [each if each is None else (each.device, each.dtype) for each in inputs]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(hits.prim_id)
        ctx.save_for_backward(*rays, hits.prim_id)  # torch raises an error if the caller modifies one before `backward`
        return hits.t, hits.u, hits.v, hits.point, hits.prim_id

    def backward(ctx: Any, *cotangents: Any) -> tuple[Any, ...]:
        origins, directions, prim_id = ctx.saved_tensors
        origins = from_origin(to_numpy(origins), ctx.geometry.origin)
        gradients = adjoint(ctx.geometry, origins, directions, prim_id, Cotangents(*cotangents[:4]))
        typed = zip(gradients, ctx.input_types, strict=True)
        return None, None, None, None, *(kind and torch.from_numpy(each).to(*kind) for each, kind in typed)

    methods = {"forward": forward, "backward": torch.autograd.function.once_differentiable(backward)}
    return type("ClosestHit", (torch.autograd.Function,), {name: staticmethod(each) for name, each in methods.items()})
