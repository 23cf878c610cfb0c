"""Arguments of queries: rays and points of any leading shape, broadcast and flattened, and the world that each ray sees."""

from ctypes import c_float
from functools import lru_cache
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import warp as wp

from wrt.accel.geometry import InstancedGeometry
from wrt.accel.queries.rays import LOWEST, Rays, check_ends, constant, filled, from_origin, is_valid, vectors
from wrt.accel.snapshot import Snapshot
from wrt.core.arrays import check_no_gradients, contiguous, float32, from_tensor, real_numbers, to_numpy
from wrt.core.checks import as_choice, shown
from wrt.core.device import to_device, upload
from wrt.core.errors import InputError
from wrt.core.types import Array, ArrayLike, Device, WarpArray, WarpStruct, WarpType
from wrt.core.warp_private import recording_tape
from wrt.kernels.query import FARTHEST, Worlds

Shape = tuple[int, ...]
INVALID = "raise", "miss"
ONE_ARRAY = "without directions, origins holds both: (..., 6)"


# --- rays and points --------------------------------------------------------------------------------------------------


def rays_of(origins: ArrayLike, directions: ArrayLike | None, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf, gradients: bool = False,
            origin: np.ndarray | None = None, invalid: str = "raise") -> tuple[Rays, Shape | None]:
    """Return the rays of a query in C order, and their shape; None for NumPy arrays (N, 3) and for Warp arrays (N,) of vec3.

    Origins and directions broadcast, t_min and t_max to the shape of both. Without directions, the last axis of `origins` holds origin and
    direction. gradients: origins and directions may require gradients. origin: of the structure's geometry; the rays are relative to
    it. invalid: see `Accelerator.closest_hit`. Raises InputError that names the argument.
    """
    if recording_tape() is not None:
        check_no_gradients(t_min=t_min, t_max=t_max)
        if not gradients:
            check_no_gradients(origins=origins, directions=directions)
    o: Any = origins
    d: Any = directions
    if invalid == "raise" and _are_rows(o, d):  # the usual case
        shape: Shape = (len(o),)
        o = o if origin is None else from_origin(o, origin)
        return Rays(o, d, _ends(t_min, shape, "t_min"), _ends(t_max, shape, "t_max")), None
    as_choice(invalid, INVALID, "invalid")
    if directions is None:
        both = _vectors(origins, "origins", 6)
        o, d = _halves(both, 0), _halves(both, 3)
    else:
        o, d = _vectors(origins, "origins"), _vectors(directions, "directions")
    if isinstance(o, wp.array) != isinstance(d, wp.array):
        raise InputError("and directions must both be Warp arrays, or both NumPy arrays", argument="origins")
    (o, d), shape = _broadcast([o, d], ("origins", "directions"))
    rays = Rays(from_origin(o, origin), from_origin(d, None), _ends(t_min, shape, "t_min"), _ends(t_max, shape, "t_max"))
    return rays if invalid == "raise" else _without_invalid(rays), shape


def pairs_of(a: ArrayLike, b: ArrayLike) -> tuple[list[Array], Shape]:
    """Broadcast points `a` and `b`, (..., 3) each. Return them in C order, (N, 3) or Warp's (N,) of vec3, and their shape."""
    return _broadcast([_vectors(a, "a"), _vectors(b, "b")], ("a", "b"))


def points_of(points: ArrayLike, origin: np.ndarray | None = None) -> tuple[np.ndarray, Shape]:
    """Return points minus `origin` as rows (N, 3) float32 in C order, and their shape. Raises InputError that names the argument."""
    array: Any = _vectors(points, "points")
    shape = array.shape if isinstance(array, wp.array) else array.shape[:-1]
    rows = (array.numpy() if isinstance(array, wp.array) else array).reshape(-1, 3)
    return vectors(from_origin(rows, origin), "points", FARTHEST), shape


def in_shape(array: Any, shape: Shape) -> Any:
    """Return an array (N, ...) of NumPy or Warp in the rays' shape. The smallest shape of Warp arrays is (1,)."""
    if isinstance(array, wp.array):
        shape = shape or (1,)
        if array.shape == shape:
            return array
        return array.reshape(shape) if array.size else wp.empty(shape, dtype=array.dtype, device=array.device)
    return array.reshape((*shape, *array.shape[1:]))


def _are_rows(origins: object, directions: object) -> bool:
    """Return whether both are NumPy arrays (N, 3) of floats, or Warp arrays (N,) of vec3."""
    if type(origins) is np.ndarray and type(directions) is np.ndarray:
        shape = origins.shape
        return len(shape) == 2 and shape[1] == 3 and shape == directions.shape and origins.dtype.kind == directions.dtype.kind == "f"
    return (isinstance(origins, wp.array) and isinstance(directions, wp.array) and origins.dtype == directions.dtype == wp.vec3
            and origins.ndim == 1 and origins.shape == directions.shape)


def _vectors(value: Any, name: str, columns: int = 3) -> Any:
    """Return a NumPy array (..., columns) of real numbers, or a Warp array: of vec3, or (..., 6) of float32."""
    array = value if type(value) is np.ndarray else from_tensor(value, name, None)
    hint = ONE_ARRAY if columns == 6 else None
    if not isinstance(array, wp.array):
        if type(array) is not np.ndarray or array.dtype.kind != "f":
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
    check_no_gradients("one array of origins and directions", origins=rays)
    columns = (slice(None),) * (rays.ndim - 1) + (slice(first, first + 3),)
    return rays[columns].view(wp.vec3)


def _flat(array: Any, shape: Shape, name: str) -> Array:
    """Broadcast vectors to the shape and flatten them: (N, 3), or Warp's (N,) of vec3."""
    n = int(np.prod(shape))
    if not isinstance(array, wp.array):
        return (array if array.shape[:-1] == shape else np.broadcast_to(array, (*shape, 3))).reshape(n, 3)
    if array.shape != shape:
        check_no_gradients(what="an array that broadcasts", **{name: array})
        sizes = (1,) * (len(shape) - array.ndim) + array.shape
        steps = (0,) * (len(shape) - array.ndim) + array.strides
        array = wp.array(ptr=array.ptr, dtype=array.dtype, shape=shape, device=array.device,
                         strides=tuple(0 if size == 1 else step for size, step in zip(sizes, steps, strict=True)))
    flat: Array = in_shape(contiguous(array), (n,))
    return flat


def _ends(value: ArrayLike, shape: Shape, name: str) -> Array:
    """Convert t_min or t_max (`name`) of rays to an array (N,). Raises InputError for other shapes, and for an invalid number."""
    if type(value) is not float:  # a float, the usual case, needs no conversion
        array = of_each(value, shape, name)
        if array.ndim:
            return array
        value = float(float32(array))
    if not value >= LOWEST[name]:
        check_ends(c_float(value).value, name)  # float32 rounds tiny negative numbers to 0
    return constant(value, shape[0] if len(shape) == 1 else int(np.prod(shape)))


def of_each(value: ArrayLike, shape: Shape, name: str, dtype: WarpType = wp.float32) -> Any:
    """Return a value of each ray as an array (N,); of NumPy, a single number as an array without axes. dtype: of Warp arrays."""
    value = from_tensor(value, name, dtype)
    if isinstance(value, wp.array):
        if value.dtype != dtype or value.shape != (shape or (1,)):
            raise InputError(f"must be {shape} {dtype.__name__}, as the rays, got {value.shape} {value.dtype.__name__}", argument=name)
        return value if value.ndim == 1 else in_shape(contiguous(value), (value.size,))
    array = real_numbers(value, name, f"a number or {shape}")
    if array.ndim == 0:
        return array
    try:
        return (array if array.shape == shape else np.broadcast_to(array, shape)).reshape(-1)
    except ValueError:
        raise InputError(f"must be a number or {shape}, as the rays, got {array.shape}", argument=name) from None


def indices_of(value: ArrayLike, shape: Shape, name: str, low: int, count: int) -> Any:
    """Return an index of each ray, low to count - 1: a NumPy array (N,) int32, or the caller's Warp array (N,) int32, unchecked."""
    array = of_each(value, shape, name, wp.int32)
    if isinstance(array, wp.array):
        return array
    if array.dtype.kind not in "iu" and array.size:
        raise InputError(f"must be a whole number or {shape} of them, got {shown(value)}", argument=name)
    if array.size and not (array.min() >= low and array.max() < count):
        raise InputError(f"must be {low} to {count - 1}, got {array.min() if array.min() < low else array.max()}", argument=name)
    return np.broadcast_to(array, (int(np.prod(shape)),)).astype(np.int32)  # 2^31 and more become negative


def _without_invalid(rays: Rays) -> Rays:
    """Replace each ray that is not valid by one that hits nothing. Warp arrays are copied to the host to find them."""
    origins, directions, t_min, t_max = map(to_numpy, rays)
    bad = ~is_valid(origins, directions, t_min, t_max)
    if not bad.any():
        return rays
    ends = np.where(bad, 0.0, t_min).astype(np.float32), np.where(bad, -np.inf, t_max).astype(np.float32)
    if rays.as_warp:
        return rays._replace(t_min=wp.array(ends[0], device=rays.origins.device), t_max=wp.array(ends[1], device=rays.origins.device))
    return Rays(np.where(bad[:, None], 0.0, origins), np.where(bad[:, None], 1.0, directions), *ends)


# --- worlds -----------------------------------------------------------------------------------------------------------


class WorldIds(NamedTuple):
    """World of each of N rays."""

    arrays: WarpStruct  # kernels.query.Worlds, on the structure's device
    filtered: bool = False  # True if `arrays` has `exclude` and `mask`.

    @property
    def columns(self) -> list[WarpArray]:
        """Fields of kernels.query.WorldRays, or FilteredRays, behind the fields of RayArrays."""
        return [getattr(self.arrays, name) for name in (("id", "exclude", "mask") if self.filtered else ("id",))]

    def of(self, rays: np.ndarray) -> "WorldIds":
        """Return the worlds of some of the rays, given by their indices."""
        ids = self.arrays.id
        some = wp.array(ids.numpy()[rays], dtype=wp.int32, device=ids.device)
        return WorldIds(filled(Worlds, (some, self.arrays.root)))


def check_world(snapshot: Snapshot, shape: Shape, world: ArrayLike | None = None, exclude: ArrayLike | None = None,
                mask: ArrayLike | None = None) -> WorldIds | None:
    """Check and convert the arguments `world`, `exclude` and `mask` of a query with rays of a shape. Return None for a query that needs
    none of them. Raises InputError that names the argument."""
    geometry, device = snapshot.geometry, snapshot.device
    if world is None and exclude is None and mask is None and not over_worlds(geometry):  # the usual case
        return None
    filters = _filters(snapshot, shape, exclude, mask)
    count = geometry.n_worlds if over_worlds(geometry) else 1
    if world is not None:
        if not over_worlds(geometry):
            raise no_worlds()
        ids = _on_device(indices_of(world, shape, "world", 0, count), device)
    elif count > 1 and shape[:1] != (count,):
        raise InputError(f"must not be None: the structure is over {count} worlds, because wrt.build makes a world of each entry of a list,"
                         f" and a ray sees one of them. Without it, the first axis of the rays must be the worlds: ({count}, ...)",
                         argument="world", hint="for one scene of these meshes: wrt.build(wrt.Scene.of(meshes))")
    elif count > 1 or filters:
        ids = _first_axis(str(device), count, int(np.prod(shape)) // count)
    else:
        return None
    return WorldIds(filled(Worlds, (ids, snapshot.roots, *filters)), bool(filters))


def _filters(snapshot: Snapshot, shape: Shape, exclude: ArrayLike | None, mask: ArrayLike | None) -> list[WarpArray]:
    """Return the arrays `exclude` and `mask` of kernels.query.Worlds; none if both arguments are None."""
    if exclude is None and mask is None:
        return []
    if snapshot.bodies is None:
        raise InputError("is for structures all of whose objects are instances", argument="mask" if exclude is None else "exclude",
                         hint="wrt.build(scene, movable=True) makes some")
    numbers, n = [], int(np.prod(shape))
    for value, name, low, count in ((exclude, "exclude", -1, 1 << 31), (mask, "mask", -1 << 31, 1 << 32)):
        if value is None or isinstance(value, int | np.integer):
            one = indices_of(-1 if value is None else value, (1,), name, low, count)
            numbers.append(_same_of_all(int(one[0]), n, snapshot.device))
        else:
            numbers.append(_on_device(indices_of(value, shape, name, low, count), snapshot.device))
    return numbers


def _same_of_all(value: int, n: int, device: Device) -> WarpArray:
    """Return an array (n,) int32 of one value. A graph can capture this call, and then has the array."""
    return wp.full(n, value, dtype=wp.int32, device=device) if device.is_capturing else _kept(value, n, str(device))


@lru_cache(8)  # so that a step of a simulation makes it once
def _kept(value: int, n: int, device: str) -> WarpArray:
    return upload(np.full(n, value, np.int32), wp.int32, wp.get_device(device))


def _on_device(ids: Any, device: Device) -> WarpArray:
    """Return the result of `indices_of` on a device, without gaps."""
    if isinstance(ids, wp.array):
        return to_device(contiguous(ids), device)
    return upload(ids, wp.int32, device)


@lru_cache(4)  # so that a step of a simulation makes it once
def _first_axis(device: str, count: int, rays: int) -> WarpArray:
    """Return the world of each ray of a query whose first axis is the world. rays: of each world."""
    return upload(np.repeat(np.arange(count, dtype=np.int32), rays), wp.int32, wp.get_device(device))


def roots_at(snapshot: Snapshot, worlds: WorldIds | None, n: int) -> np.ndarray | None:
    """Return the root node of each ray's world, (n,) int32; -1 in a world that does not exist; None for a structure over one mesh."""
    if snapshot.roots is None:
        return None
    roots = np.append(snapshot.roots.numpy(), np.int32(-1))
    if worlds is None:
        return np.full(n, roots[0], np.int32)
    ids = worlds.arrays.id.numpy()
    return np.asarray(roots[np.where((ids >= 0) & (ids < len(roots) - 1), ids, -1)])


def no_worlds() -> InputError:
    """Return the error for an argument `world` where there are no worlds."""
    return InputError("is for structures over worlds, which wrt.build makes from a list of meshes or scenes", argument="world")


def over_worlds(geometry: object) -> TypeGuard[InstancedGeometry]:
    """Return whether a structure was built from a list of worlds."""
    return isinstance(geometry, InstancedGeometry) and geometry.worlds is not None
