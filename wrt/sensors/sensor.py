"""Rays of a sensor at one or many poses, and images of their hits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Generic, Protocol

import numpy as np
import warp as wp

from wrt.core.arrays import from_tensor, given_like, is_tensor, on_cpu, to_numpy, to_tensor_like, to_warp
from wrt.core.checks import as_array, shown
from wrt.core.device import empty_aligned
from wrt.core.errors import InputError
from wrt.core.threads import run_all, thread_count
from wrt.core.types import ArrayLike, ArrayT
from wrt.scene.values import as_number, type_of
from wrt.sensors.images import Images

if TYPE_CHECKING:
    from wrt.accel.queries.accelerator import Accelerator

MAX_ROTATION_ERROR = 1e-5  # largest entry of |R R^T - I| for the rotation matrix R of a pose
RAYS_PER_JOB = 1 << 16
RAYS_PER_PART = 4096  # of one matrix product: NumPy's library starts its own threads for larger ones, which wait for each other


class FoundHits(Protocol):
    """Part of `Hits` that images need."""

    t: Any
    prim_id: Any

    @property
    def point(self) -> Any: ...


@dataclass(frozen=True, eq=False)
class Frame:
    """Directions of a sensor's pixels in its own frame, float64: of one sensor, or of F sensors, in a first axis.

    Either all `directions` (..., rows, columns, 3), or the numbers from which a sum and a product make each: `across` (..., columns, 2) and
    `down` (..., rows, 4), as in kernels.shade.sensors.Sensors.
    """

    axis: int  # of the frame, along which depth is measured
    directions: np.ndarray | None = None
    across: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    down: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns), or (F, rows, columns)."""
        return (*self.down.shape[:-1], self.across.shape[-2]) if self.directions is None else self.directions.shape[:-1]

    def local(self) -> np.ndarray:
        """Return the directions of all pixels, (*shape, 3)."""
        if self.directions is not None:
            return self.directions
        c, r = self.across[..., None, :, :], self.down[..., :, None, :]
        return np.stack(np.broadcast_arrays(r[..., 0] * c[..., 0] + r[..., 2], r[..., 0] * c[..., 1] + r[..., 3], r[..., 1]), axis=-1)

    def largest(self) -> float:
        """Return a bound on the absolute values of the directions; NaN if one is NaN."""
        parts = (self.directions,) if self.directions is not None else (self.across, self.down)
        return float(np.prod([max(np.abs(part).max(), 1.0) for part in parts]))


@dataclass(frozen=True, eq=False)
class Sensor(Generic[ArrayT]):
    """A sensor at one pose or at many: `trace` makes its rays where it traces them; `origins` and `directions` are its rays as arrays.

    Images are arrays of NumPy, or of the library of the hits (Warp, PyTorch, JAX), on their device. `pinhole`, `fisheye` and the LiDARs
    make sensors. The class keeps the arrays that it is given.

    Attributes
    ----------
    frame : Frame
        Directions in the sensor's frame.
    poses : (..., 4, 4) float64
        Sensor to world: one, or one for each image, row or column.
    rolling : int or None
        Axis of an image, 0 or 1, along which each row or column has its own pose.
    shape : tuple
        (rows, columns) of an image, or (B, rows, columns) for B poses; N is the product.
    like : object
        Array of the library and device that the rays have.
    """

    frame: Frame
    poses: np.ndarray
    rolling: int | None
    shape: tuple[int, ...]
    like: object = None
    on_devices: dict[str, Any] = field(default_factory=dict, repr=False)  # Frame and poses on devices, which calls of `trace` share.

    @property
    def origins(self) -> ArrayT:
        """Origins of the rays in world space, (N, 3) float32, or a Warp array (N,) of vec3: one image row after another, one image after
        another. Origins farther than 1,024 from 0 are float64 (vec3d), if float32 would round them."""
        return self._made[0]

    @property
    def directions(self) -> ArrayT:
        """Directions of the rays, as `origins`; always float32."""
        return self._made[1]

    @cached_property
    def _made(self) -> tuple[Any, Any]:
        return make_rays(self)

    @cached_property
    def axis(self) -> np.ndarray:
        """Unit vector in world space along which `depth` measures, float64: (3,), or an array that broadcasts with (*shape, 3)."""
        axes = self.poses[..., :3, self.frame.axis]  # (..., 3) or (..., rows or columns, 3)
        if self.rolling is not None:
            axes = np.expand_dims(axes, axes.ndim - 1 - self.rolling)
        elif axes.ndim > 1 or len(self.shape) > 2:
            axes = axes[..., None, None, :]
        return axes

    def trace(self, accel: Accelerator, poses: ArrayLike | None = None, out: Images | str | Sequence[str] = "depth",
              world: ArrayLike | None = None, t_max: float = np.inf, threads: int | None = None) -> Images:
        """Trace the sensor's rays, which are made in the query, and return pictures of their hits.

        Hits are those of `closest_hit` for the rays (`out=("origin", "direction")` shows them), to the last bit. No ray is stored. If
        poses and `world` are Warp arrays and `out` is Images, the call copies nothing to or from the host and allocates nothing, and a
        CUDA graph can capture it (docs/sensors.md).

        Parameters
        ----------
        accel : Accelerator
            Structure over meshes, instances or worlds.
        poses : Warp array or tensor on the structure's device, or array_like of (B, 4, 4)
            Sensor to world, in place of the sensor's own poses: B of wp.transformf or mat44f, or rows (B, 7) of position and quaternion,
            (B, 3, 4) or (B, 4, 4); with a rolling sensor, (rows or columns,) or (B, rows or columns) of them. Values of Warp arrays are
            not checked: at a pose that is not finite, rays miss.
        out : Images, str or sequence of str
            `Images` with the arrays to fill, or the names of the images to make.
        world : int or array of int32, optional
            World of each image, or of each pose of a rolling sensor. Without it, image i sees world i, or pose i, if there are as many as
            worlds. Values of Warp arrays are not checked: in a world that does not exist, rays miss.
        t_max : float
            End of the rays, in units of the direction's length.
        threads : int, optional
            Threads on the CPU; one per core by default.

        Returns
        -------
        Images
            `out`, or new images of the shape (B, rows, columns), or (rows, columns) for a single pose that is not in an array.

        Raises
        ------
        InputError
            Names the argument and what was expected.
        """
        from wrt.accel.queries.images import trace_sensor  # not at the top: the arrays of rays need no structure

        if is_tensor(poses):
            poses = to_warp(from_tensor(poses, "poses", None))
        elif poses is not None and not isinstance(poses, wp.array):
            poses = as_poses(poses)
        if t_max != np.inf:
            t_max = as_number(t_max, "t_max", low=0.0)
        names = [each.name for each in fields(Images)]
        wanted: dict[str, Any] = vars(out) if isinstance(out, Images) else dict.fromkeys([out] if isinstance(out, str) else out)
        if unknown := [name for name in wanted if name not in names]:
            raise InputError(f"must be Images, or some of {', '.join(names)}, got {shown(unknown[0])}", argument="out")
        if isinstance(out, Images):
            wanted = {name: array for name, array in wanted.items() if array is not None}
        images = trace_sensor(accel, self, poses, wanted, world, t_max, threads)
        return out if isinstance(out, Images) else Images(**images)

    @property
    def rays(self) -> tuple[Any, Any]:
        """Origins and directions as pictures: (*shape, 3), or Warp arrays of vec3 in `shape`, in the memory of the rays.

        `accel.closest_hit(*sensor.rays)` returns hits in this shape. On the CPU, small pictures are then traced in tiles of 4x4 pixels,
        which is faster.
        """
        return self.picture(self.origins), self.picture(self.directions)

    def picture(self, values: ArrayLike) -> Any:
        """Reshape values of the rays, (N, ...) or (*shape, ...), such as hits.prim_id or hits.normal, to (*shape, ...).

        The result shares the memory of `values`, unless the library copies to reshape (JAX).
        Raises InputError if there is not one value per ray.
        """
        array = from_tensor(values, "values", None)
        array = array if isinstance(array, wp.array) else np.asarray(array)
        n, axes = int(np.prod(self.shape)), len(self.shape)
        if array.shape[:axes] == self.shape:
            return values
        if array.shape[:1] != (n,):
            raise InputError(f"must have one row per ray, ({n}, ...), got {array.shape}", argument="values")
        shape = (*self.shape, *array.shape[1:])
        own: Any = values
        if hasattr(own, "reshape"):
            return own.reshape(shape)
        image, give = array.reshape(shape), to_tensor_like(values)
        return image if give is None else give(image)

    def range(self, hits: FoundHits) -> Any:
        """Return the distance of each hit from the sensor, `shape` float32 in scene units; inf on a miss."""
        return self._scaled(hits, np.linalg.norm(self._directions().astype(np.float64), axis=-1))

    def depth(self, hits: FoundHits) -> Any:
        """Return the distance of each hit along the sensor's axis, `shape` float32 in scene units.

        The depth is inf on a miss and negative behind the sensor. For a camera it is z in the camera's frame, as in depth images.
        """
        if self.axis.ndim == 1:
            return self._scaled(hits, self._directions().astype(np.float64) @ self.axis)
        return self._scaled(hits, np.einsum("...k,...k->...", self._directions(), self.axis))

    def points(self, hits: FoundHits | ArrayLike) -> Any:
        """Return the points of hits, or of measured ranges, in world space: (*shape, 3) float32, NaN on a miss.

        Parameters
        ----------
        hits
            Hits of the rays, or ranges such as those of `with_range_noise`, (N,) or `shape`; inf is a miss.

        Raises
        ------
        InputError
            If there is not one value per ray.
        """
        if hasattr(hits, "prim_id"):
            found: Any = hits
            return self.picture(found.point)
        ranges = to_numpy(self.picture(hits))[..., None]
        ways = self._directions().astype(np.float64)
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        places = np.full(ways.shape, np.nan)
        np.multiply(ranges, ways, out=places, where=np.isfinite(ranges))
        origins = to_numpy(self.origins).reshape(ways.shape)
        return given_like(hits, (places + origins).astype(origins.dtype))

    def _directions(self) -> np.ndarray:
        return to_numpy(self.directions).reshape(*self.shape, 3)

    def _scaled(self, hits: FoundHits, factor: np.ndarray) -> Any:
        if not hasattr(hits, "t"):
            raise InputError(f"must be the Hits that closest_hit returned, got {shown(hits)}", argument="hits")
        t = to_numpy(self.picture(hits.t))
        scaled = np.full(t.shape, np.inf)
        np.multiply(t, factor, out=scaled, where=np.isfinite(t))
        return given_like(hits.t, scaled.astype(np.float32))


def make_sensor(frame: Frame, pose: ArrayLike | None, rolling: int | None, like: object) -> Sensor[Any]:
    """Make a sensor of a frame.

    - pose: (4, 4) or (B, 4, 4); with `rolling`, (rows or columns, 4, 4) or (B, rows or columns, 4, 4); or OpenCV's pair (R, t).
    - like: array of the library and device that the rays get; None: `pose`.
    - rolling: axis of an image, 0 or 1, along which each row or column has its own pose; None: all pixels of an image share a pose.

    Raises InputError that names the argument and what was expected.
    """
    poses, size = as_poses(pose), frame.shape[-2:]
    many, own = poses.shape[:-2], () if rolling is None else (size[rolling],)
    if len(many) > 1 + len(own) or many[len(many) - len(own):] != own:
        line = ", ".join(map(str, (*own, 4, 4)))
        raise InputError(f"must be ({line}) or (B, {line}), got {poses.shape}", argument="pose")
    limit = float(np.finfo(np.float32).max)
    if not (frame.largest() <= limit / 2.0 and np.abs(poses[..., :3, 3]).max() <= limit):  # rotated by at most sqrt(3)
        raise InputError("rays of this sensor and pose exceed the range of float32")
    batch = many[:len(many) - len(own)]
    try:
        batch = np.broadcast_shapes(batch, frame.shape[:-2])
    except ValueError:
        raise InputError(f"and pose must be of equally many cameras, or of one: got {frame.shape[0]} intrinsics and {batch[0]} poses",
                         argument="intrinsics") from None
    return Sensor(frame, poses.copy(), rolling, (*batch, *size), (pose[0] if isinstance(pose, tuple) else pose) if like is None else like)


def make_rays(sensor: Sensor[Any]) -> tuple[Any, Any]:
    """Return all origins and directions of a sensor."""
    poses, local, shape, rolling = sensor.poses, sensor.frame.local(), sensor.shape, sensor.rolling
    batch, size = shape[:-2], (*shape[-2:], 3)
    own = () if rolling is None else (size[rolling],)
    images = int(np.prod(batch))
    origins, directions = (empty_aligned((images, *size), kind) for kind in (type_of(poses[..., :3, 3]), np.float32))
    each = np.broadcast_to(poses, (*batch, *own, 4, 4)).reshape(images, *own, 4, 4)
    frame_rays = np.broadcast_to(local, (*batch, *size)).reshape(images, *size)

    def fill(parts: list[tuple[int, slice]]) -> None:
        for i, rows in parts:
            frames = each[i, rows] if rolling == 0 else each[i]
            place = frames[..., :3, 3]
            directions[i, rows] = _turned(frame_rays[i, rows], frames[..., :3, :3], rolling)
            origins[i, rows] = place[:, None] if rolling == 0 else place

    height = max(1, RAYS_PER_PART // size[1])
    parts = [(i, slice(row, row + height)) for i in range(images) for row in range(0, size[0], height)]
    step = max(1, RAYS_PER_JOB // (min(height, size[0]) * size[1]))
    run_all([partial(fill, parts[first:first + step]) for first in range(0, len(parts), step)], thread_count(None))
    return _of_library(origins.reshape(-1, 3), sensor.like), _of_library(directions.reshape(-1, 3), sensor.like)


def _turned(local: np.ndarray, rotation: np.ndarray, rolling: int | None) -> np.ndarray:
    """Rotate directions (rows, columns, 3) by one matrix, or by one of each row or column."""
    if rolling is None:
        return (local.reshape(-1, 3) @ rotation.T).reshape(local.shape)
    if rolling == 0:
        return local @ rotation.transpose(0, 2, 1)
    return (local.swapaxes(0, 1) @ rotation.transpose(0, 2, 1)).swapaxes(0, 1)


def as_doubles(value: ArrayLike, name: str) -> np.ndarray:
    """Return an argument, also a tensor, as a NumPy array of float64. Raises InputError that names the argument."""
    array = as_array(to_numpy(value) if is_tensor(value) or isinstance(value, wp.array) else value, np.float64, name)
    return array.reshape(()) if getattr(value, "shape", None) == () or isinstance(value, int | float) else array  # as before as_array


def as_poses(pose: ArrayLike | None) -> np.ndarray:
    """Return poses (..., 4, 4) float64. Raises InputError unless each is a rotation and a translation."""
    if pose is None:
        return np.eye(4)
    if isinstance(pose, tuple | list) and len(pose) == 2:
        parts = [as_doubles(part, f"pose[{i}]") for i, part in enumerate(pose)]
        pose = pose if parts[0].shape[-2:] == (4, 4) else _from_opencv(*parts)
    poses = as_doubles(pose, "pose")
    if poses.shape[-2:] != (4, 4) or poses.size == 0:
        raise InputError(f"must be (4, 4) or (B, 4, 4), sensor to world, got {poses.shape}", argument="pose")
    _require(np.isfinite(poses).all(axis=(-2, -1)), "finite")
    _require(np.abs(poses[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1) <= 1e-6, "affine (last row 0 0 0 1)")
    rotation = poses[..., :3, :3]
    error = np.abs(rotation @ rotation.swapaxes(-2, -1) - np.eye(3)).max(axis=(-2, -1))
    _require((error <= MAX_ROTATION_ERROR) & (np.linalg.det(rotation) > 0.0), "a rotation and a translation")
    return poses


def _require(good: np.ndarray, what: str) -> None:
    """Raise InputError that names the first pose that is not `what`. good: bool for each pose."""
    if not good.all():
        place = np.unravel_index(int(np.argmin(good)), good.shape) if good.ndim else ()
        raise InputError(f"must be {what}" + (f"; pose {', '.join(map(str, place))} is not" if place else ""), argument="pose")


def _from_opencv(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4), sensor to world, from OpenCV's R and t, world to sensor.

    rotation: (..., 3, 3), or a rotation vector (3,) or (3, 1); shift: (..., 3) or (..., 3, 1).
    """
    for i, part in enumerate((rotation, shift)):
        if not (np.abs(part) <= np.finfo(np.float32).max).all():
            raise InputError("must be finite, and within the range of float32", argument=f"pose[{i}]")
    if rotation.shape in ((3,), (3, 1)):  # Rodrigues' formula, for the matrix of the cross product with the axis
        angle = np.linalg.norm(rotation)
        x, y, z = rotation.reshape(3) / (angle or 1.0)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    many = rotation.shape[:-2]
    if rotation.shape[-2:] != (3, 3) or shift.shape not in ((*many, 3), (*many, 3, 1)):
        raise InputError(f"must be (R, t), of (3, 3) and (3,) or of (B, 3, 3) and (B, 3), got {rotation.shape} and {shift.shape}",
                         argument="pose")
    poses = np.zeros((*many, 4, 4))
    poses[..., :3, :3], poses[..., 3, 3] = rotation.swapaxes(-2, -1), 1.0
    poses[..., :3, 3] = -(poses[..., :3, :3] @ shift.reshape(*many, 3, 1))[..., 0]
    return poses


def _of_library(rays: np.ndarray, like: object) -> Any:
    """Return vectors (N, 3) as an array of the library and device of `like`, without a copy on the CPU."""
    kind = wp.vec3d if rays.dtype == np.float64 else wp.vec3
    if isinstance(like, wp.array):
        return to_warp(rays, kind).to(like.device)
    give = to_tensor_like(like)
    if give is None:
        return rays
    return give(rays if not is_tensor(like) or on_cpu(like) else to_warp(rays, kind).to(to_warp(like).device))
