"""Closest hits with gradients for PyTorch: `wrt.torch.closest_hit`."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.gradients import Cotangents, adjoint
from wrt.accel.queries.rays import from_origin
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
        Vertices of the mesh. If they differ from the structure's vertices, the structure is refitted to them. None: no refit.
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


@cache
def _function() -> Any:  # a subclass of torch.autograd.Function
    import torch

    def as_it_is_on_cpu(each: Any) -> Any:  # far from 0, float64 counts
        return each if each.dtype == torch.float64 and each.device.type == "cpu" else each.float()

    def forward(ctx: Any, accel: OneMesh, rebuild_at: float, t_min: Any, t_max: Any, *inputs: Any) -> tuple[Any, ...]:
        vertices, *rays = (each if each is None else as_it_is_on_cpu(each).detach().contiguous() for each in inputs)
        hits = hits_of(accel, vertices, (*rays, t_min, t_max), rebuild_at)
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
