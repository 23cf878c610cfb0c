"""Rays and points of any leading shape: broadcast and flattened for a query, whose results then get their shape."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.rays import Rays, from_origin, is_valid, rays_of, vectors
from wrt.core.arrays import from_tensor, real_numbers
from wrt.core.checks import as_choice
from wrt.core.errors import InputError
from wrt.core.types import Array, ArrayLike, WarpArray
from wrt.core.warp_private import recording_tape
from wrt.kernels.query import FARTHEST

Shape = tuple[int, ...]
INVALID = "raise", "miss"
ONE_ARRAY = "without directions, origins holds both: (..., 6)"


def shaped_rays(origins: ArrayLike, directions: ArrayLike | None, t_min: ArrayLike, t_max: ArrayLike, gradients: bool = False,
                invalid: str = "raise", origin: np.ndarray | None = None) -> tuple[Rays, Shape]:
    """Return the rays in C order, and their shape. Origins and directions broadcast, t_min and t_max to the shape of both.

    Without directions, the last axis of `origins` holds origin and direction. invalid: see `Accelerator.closest_hit`; origin: `rays_of`.
    Raises InputError that names the argument.
    """
    as_choice(invalid, INVALID, "invalid")
    if directions is None:
        both = _vectors(origins, "origins", 6)
        arrays = [_halves(both, 0), _halves(both, 3)]
    else:
        arrays = [_vectors(origins, "origins", 3), _vectors(directions, "directions", 3)]
    if len({isinstance(array, wp.array) for array in arrays}) > 1:
        raise InputError("and directions must both be Warp arrays, or both NumPy arrays", argument="origins")
    flat, shape = _broadcast(arrays, ("origins", "directions"))
    ends = [_of_each(end, shape, name) for end, name in ((t_min, "t_min"), (t_max, "t_max"))]
    rays = rays_of(flat[0], flat[1], ends[0], ends[1], gradients, origin)
    return rays if invalid == "raise" else _without_invalid(rays), shape


def shaped_pairs(a: ArrayLike, b: ArrayLike) -> tuple[list[Array], Shape]:
    """Broadcast points `a` and `b`, (..., 3) each. Return them in C order, (N, 3) or Warp's (N,) of vec3, and their shape."""
    return _broadcast([_vectors(a, "a", 3), _vectors(b, "b", 3)], ("a", "b"))


def shaped_points(points: ArrayLike, world: ArrayLike | None,
                  origin: np.ndarray | None = None) -> tuple[np.ndarray, Shape, ArrayLike | None]:
    """Return points minus `origin` as rows (N, 3) float32 in C order, their shape, and the world of each row.

    Raises InputError that names the argument.
    """
    array: Any = _vectors(points, "points", 3)
    shape = array.shape if isinstance(array, wp.array) else array.shape[:-1]
    rows = (array.numpy() if isinstance(array, wp.array) else array).reshape(-1, 3)
    return vectors(from_origin(rows, origin), "points", FARTHEST), shape, worlds_of_each(world, shape)


def _vectors(value: ArrayLike, name: str, columns: int) -> Array:
    """Return a NumPy array (..., columns), or a Warp array: of vec3, or (..., 6) of float32."""
    array = from_tensor(value, name, None)
    hint = ONE_ARRAY if columns == 6 else None
    if not isinstance(array, wp.array):
        array = real_numbers(array, name, f"(..., {columns})")
        if array.shape[-1:] != (columns,):
            raise InputError(f"must be (..., {columns}), got {array.shape}", argument=name,
                             hint=hint or ("pass it alone for origins and directions in one array" if array.shape[-1:] == (6,) else None))
        return array
    if columns == 3 and array.dtype in (wp.vec3, wp.vec3d):
        return array
    if array.dtype != wp.float32 or array.shape[-1] != columns:
        kinds = "(..., 6) float32" if columns == 6 else "of vec3, or (..., 3) float32"
        raise InputError(f"must be {kinds}, got {array.shape} {array.dtype.__name__}", argument=name, hint=hint)
    return array if columns == 6 else array.view(wp.vec3)


def _broadcast(arrays: list[Any], names: tuple[str, str]) -> tuple[list[Array], Shape]:
    """Broadcast two arrays of vectors and flatten them; return also their common shape."""
    shapes = [array.shape if isinstance(array, wp.array) else array.shape[:-1] for array in arrays]
    try:
        shape = np.broadcast_shapes(*shapes)
    except ValueError:
        raise InputError(f"must have the shape of {names[0]}, or one that broadcasts with it: {shapes[1]} does not with {shapes[0]}",
                         argument=names[1]) from None
    return [_flat(array, shape, name) for array, name in zip(arrays, names, strict=True)], shape


def _halves(rays: Array, first: int) -> Array:
    """Return the columns first .. first + 2 of rays (..., 6)."""
    if not isinstance(rays, wp.array):
        return rays[..., first:first + 3]
    _require_no_gradient(rays, "origins", "origins and directions in one array")
    columns = (slice(None),) * (rays.ndim - 1) + (slice(first, first + 3),)
    return rays[columns].view(wp.vec3)


def _flat(array: Any, shape: Shape, name: str) -> Array:
    """Broadcast vectors to the shape and flatten them: (N, 3), or Warp's (N,) of vec3."""
    n = int(np.prod(shape))
    if not isinstance(array, wp.array):
        return np.broadcast_to(array, (*shape, 3)).reshape(n, 3)
    if array.shape != shape:
        _require_no_gradient(array, name, "an array that broadcasts")
        sizes = (1,) * (len(shape) - array.ndim) + array.shape
        steps = (0,) * (len(shape) - array.ndim) + array.strides
        array = wp.array(ptr=array.ptr, dtype=array.dtype, shape=shape, device=array.device,
                         strides=tuple(0 if size == 1 else step for size, step in zip(sizes, steps, strict=True))).contiguous()
    flat: Array = in_shape(array if array.is_contiguous else array.contiguous(), (n,))
    return flat


def _of_each(value: ArrayLike, shape: Shape, name: str) -> Any:
    """Return a value of each ray as an array (N,); a single number stays as it is."""
    value = from_tensor(value, name, None)
    if isinstance(value, wp.array):
        return flat_array(value, shape, name)
    array = real_numbers(value, name, f"a number or {shape}")
    if array.ndim == 0:
        return array
    try:
        return np.broadcast_to(array, shape).reshape(-1)
    except ValueError:
        raise InputError(f"must be a number or {shape}, as the rays, got {array.shape}", argument=name) from None


def worlds_of_each(world: ArrayLike | None, shape: Shape) -> ArrayLike | None:
    """Return the argument `world` with one index per ray, (N,); None and a single number stay as they are."""
    return None if world is None else _of_each(world, shape, "world")


def flat_arrays(arrays: Iterable[Any], shape: Shape, names: Iterable[str]) -> list[Any]:
    """Return arrays of the rays' shape as `flat_array`."""
    return [flat_array(array, shape, name) for array, name in zip(arrays, names, strict=True)]


def flat_array(array: Any, shape: Shape, name: str) -> Array:
    """Return an array of the rays' shape as (N,), in the same memory. Raises InputError for other shapes and with gaps."""
    array = from_tensor(array, name, None)
    mine = getattr(array, "shape", None)
    if mine != shape and not (isinstance(array, wp.array) and mine == (shape or (1,))):
        raise InputError(f"must have the rays' shape {shape}, got {mine or type(array).__name__}", argument=name)
    if array.size and not (array.is_contiguous if isinstance(array, wp.array) else array.flags.c_contiguous):
        raise InputError("must be contiguous", argument=name)
    return in_shape(array, (int(np.prod(shape)),)) if isinstance(array, wp.array) else array.reshape(-1)


def in_shape(array: Any, shape: Shape) -> Any:
    """Return an array (N, ...) of NumPy or Warp in the rays' shape. The smallest shape of Warp arrays is (1,)."""
    if isinstance(array, wp.array):
        shape = shape or (1,)
        if array.shape == shape:
            return array
        return array.reshape(shape) if array.size else wp.empty(shape, dtype=array.dtype, device=array.device)
    return array.reshape((*shape, *array.shape[1:]))


def _require_no_gradient(array: WarpArray, name: str, what: str) -> None:
    if recording_tape() is not None and array.requires_grad:
        raise InputError(f"requires gradients and a wp.Tape is recording, but {what} has none: pass two arrays of one shape", argument=name)


def _without_invalid(rays: Rays) -> Rays:
    """Replace each ray that is not valid by one that hits nothing. Warp arrays are copied to the host to find them."""
    origins, directions, t_min, t_max = (array.numpy() if isinstance(array, wp.array) else array for array in rays)
    bad = ~is_valid(origins, directions, t_min, t_max)
    if not bad.any():
        return rays
    ends = np.where(bad, 0.0, t_min).astype(np.float32), np.where(bad, -np.inf, t_max).astype(np.float32)
    if rays.as_warp:
        return rays._replace(t_min=wp.array(ends[0], device=rays.origins.device), t_max=wp.array(ends[1], device=rays.origins.device))
    return Rays(np.where(bad[:, None], 0.0, origins), np.where(bad[:, None], 1.0, directions), *ends)
