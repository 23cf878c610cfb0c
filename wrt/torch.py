"""Closest hits with gradients for PyTorch: `wrt.torch.closest_hit`."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.queries.gradients import Cotangents, adjoint
from wrt.accel.tensors import HitTensors, hits_of, library
from wrt.core.types import ArrayLike

if TYPE_CHECKING:
    from torch import Tensor


def closest_hit(accel: OneMesh, vertices: Tensor | None, origins: ArrayLike, directions: ArrayLike, t_min: ArrayLike = 0.0,
                t_max: ArrayLike = np.inf, *, rebuild_at: float = 2.0) -> HitTensors[Tensor]:
    """Find the closest hit of each ray, with gradients of t, u, v and point at fixed prim_id.

    Gradients are computed in float64 on the CPU and have the same bits in every run; those of misses are 0. There are no second
    derivatives (docs/gradients.md).

    Parameters
    ----------
    accel : OneMesh
        Structure over one mesh without spheres.
    vertices : (V, 3) tensor or None
        Vertices that the structure is refitted to if they are new; None leaves it as it is.
    origins, directions, t_min, t_max
        See `Accelerator.closest_hit`; tensors on the CPU or a GPU, taken as float32.
    rebuild_at : float
        See `OneMesh.refit`.

    Returns
    -------
    HitTensors
        Tensors on the CPU, or on the GPU of `origins`.

    Raises
    ------
    InputError
        Names the argument and what was expected; also without torch.
    """
    torch = library("torch")
    given = (each if each is None else torch.as_tensor(each) for each in (vertices, origins, directions))
    return HitTensors(*_function().apply(accel, rebuild_at, t_min, t_max, *given))


@cache
def _function() -> Any:  # a class of torch.autograd.Function
    torch = library("torch")

    def forward(ctx: Any, accel: OneMesh, rebuild_at: float, t_min: Any, t_max: Any, *given: Any) -> tuple[Any, ...]:
        vertices, *rays = (each if each is None else each.detach().float().contiguous() for each in given)
        hits = hits_of(accel, vertices, (*rays, t_min, t_max), rebuild_at)
        ctx.geometry = hits.source[0].mesh  # type: ignore[index]
        ctx.leaves = [each if each is None else (each.device, each.dtype) for each in given]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(hits.prim_id)
        ctx.save_for_backward(*rays, hits.prim_id)  # torch tells if one was written to meanwhile
        return hits.t, hits.u, hits.v, hits.point, hits.prim_id

    def backward(ctx: Any, *cotangents: Any) -> tuple[Any, ...]:
        origins, directions, prim_id = ctx.saved_tensors
        found = adjoint(ctx.geometry, origins, directions, prim_id, Cotangents(*cotangents[:4]))
        leaves = zip(found, ctx.leaves, strict=True)
        return None, None, None, None, *(leaf and torch.from_numpy(each).to(*leaf) for each, leaf in leaves)

    methods = {"forward": forward, "backward": torch.autograd.function.once_differentiable(backward)}
    return type("ClosestHit", (torch.autograd.Function,), {name: staticmethod(each) for name, each in methods.items()})
