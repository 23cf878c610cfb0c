"""Images of sensors: rays made in the query, and pictures of their hits (kernels.shade.sensors)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.queries.accelerator import Accelerator, present
from wrt.accel.queries.arguments import no_worlds, over_worlds
from wrt.accel.queries.batches import BUFFERED, MOST_PACKED, RAYS_PER_LAUNCH, Tracer, has_stream, new_scratch, tracer, world_tracer
from wrt.accel.queries.hit_points import device_scene, require
from wrt.accel.queries.raw_launches import SMALL, launch_raw
from wrt.accel.queries.rays import filled
from wrt.accel.queries.transforms import require_on, transforms_in, transforms_of
from wrt.accel.snapshot import Snapshot, Structure
from wrt.core.arrays import from_tensor
from wrt.core.checks import shown
from wrt.core.device import launch_on, made_once, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all, thread_count
from wrt.core.types import ArrayLike, Device, Kernel, WarpArray, WarpStruct
from wrt.core.warp_private import captures_on_cpu, struct_record
from wrt.kernels.query import HitArrays, WorldRays
from wrt.kernels.shade import sensors as kernels
from wrt.kernels.shade.hit_points import ObjectIds
from wrt.kernels.warp_private import fields_of

Shape = tuple[int, ...]
AT_HITS = "object", "instance", "face", "point", "normal"  # read the scene on the device


def images_of(out: Mapping[str, Any], shape: Shape, device: Device) -> tuple[dict[str, WarpArray], WarpStruct]:
    """Return the images by name, new ones in place of None, and their kernels.shade.sensors.Images.

    Raises InputError, which names the array, for arrays of another shape, type or device.
    """
    target: Any = kernels.Images()
    owners = {name: part for part in (target, target.hits, target.places) for name in fields_of(part)}
    images = {}
    for name, given in out.items():
        kind = fields_of(owners[name])[name].dtype
        array = wp.empty(shape, dtype=kind, device=device) if given is None else from_tensor(given, f"out.{name}", kind)
        if not (isinstance(array, wp.array) and array.shape == shape and array.dtype == kind):
            raise InputError(f"must be a Warp array {shape} of {kind.__name__}, got {shown(array)}", argument=f"out.{name}")
        require_on(device, **{f"out.{name}": array})
        setattr(owners[name], name, array.reshape((prod(shape),)))
        images[name] = array
    return images, target


def trace_sensor(accel: Accelerator, sensor: Any, poses: WarpArray | np.ndarray | None, out: Mapping[str, Any],
                 world: ArrayLike | None, t_max: float, threads: int | None) -> dict[str, WarpArray]:
    """Do as wrt.sensors.Sensor.trace. poses: unchecked Warp array, or checked (..., 4, 4) float64. out: images by name; None: new ones."""
    snapshot = present(accel)
    (*some, rows, columns), device = sensor.frame.shape, snapshot.device
    sensors: Any = kernels.Sensors()
    sensors.rows, sensors.columns, sensors.axis, sensors.t_max = rows, columns, sensor.frame.axis, t_max
    sensors.tiled = rows % kernels.SIDE == columns % kernels.SIDE == 0
    own = () if sensor.rolling is None else ((rows, columns)[sensor.rolling],)

    def fits(lead: Shape) -> bool:
        return len(lead) <= 1 + len(own) and lead[max(len(lead) - len(own), 0):] == own

    if device.alias not in sensor.on_devices:
        frame = sensor.frame
        ways = np.zeros((0, 3)) if frame.directions is None else frame.directions
        sensor.on_devices[device.alias] = (upload(frame.across.reshape(-1, 2), wp.vec2d, device),
                                           upload(frame.down.reshape(-1, 4), wp.vec4d, device),
                                           upload(ways.reshape(-1, 3), wp.vec3, device), transforms_of(sensor.poses, 16, device))
    sensors.across, sensors.down, sensors.directions, sensors.poses = sensor.on_devices[device.alias]
    lead = sensor.poses.shape[:-2]
    if isinstance(poses, np.ndarray) and fits(poses.shape[:-2]):
        sensors.poses, lead = transforms_of(poses, 16, device), poses.shape[:-2]
    elif poses is not None:
        given: Any = poses if isinstance(poses, wp.array) else wp.array(poses, dtype=wp.float64, device="cpu")
        require_on(given.device if isinstance(poses, np.ndarray) else device, poses=given)
        sensors.poses, lead = transforms_in(given, "poses", ", ".join(("B", *map(str, own))), fits, False)
    batch = lead[:len(lead) - len(own)]
    if some and batch and batch[0] != some[0] and 1 not in (batch[0], some[0]):
        raise InputError(f"must be one, or {some[0]}, one for each camera, got {batch[0]}", argument="poses")
    shape = (*(max(tuple(some), batch) if some and batch else batch or some), rows, columns)
    count, each = int(np.prod(shape[:-2])), int(np.prod(lead))
    sensors.frames = max(prod(some), 1)
    sensors.own = 0 if prod(batch) == 1 else max(prod(own), 1)
    sensors.row_step, sensors.column_step = int(sensor.rolling == 0), int(sensor.rolling == 1)
    if snapshot.geometry.origin is not None:
        sensors.origin = wp.vec3d(*snapshot.geometry.origin)
    images, target = images_of(out, shape, device)
    worlds = set_worlds(snapshot, sensors, world, count, each)
    trace_images(snapshot, sensors, target, out, prod(shape), worlds, threads)
    return images


def set_worlds(snapshot: Snapshot, sensors: Any, world: ArrayLike | None, images: int, poses: int) -> bool:
    """Set the world of each image or pose in kernels.shade.sensors.Sensors; return whether the structure is over worlds.

    Raises InputError that names `world`.
    """
    geometry = snapshot.geometry
    if not over_worlds(geometry):
        if world is not None:
            raise no_worlds()
        return False
    given = from_tensor(world, "world", wp.int32) if world is not None else None
    if given is None:
        count = geometry.n_worlds
    elif isinstance(given, wp.array):
        require_on(snapshot.device, world=given)
        count = given.size if given.dtype == wp.int32 else 0
        if count:
            sensors.worlds.id = given.reshape((count,))
    else:
        ids = np.asarray(given)
        if ids.dtype.kind not in "iu" or not ((ids >= 0) & (ids < geometry.n_worlds)).all():
            raise InputError(f"must be 0 to {geometry.n_worlds - 1}, got {shown(world)}", argument="world")
        count = ids.size
        sensors.worlds.id = upload(ids.reshape(-1), wp.int32, snapshot.device)
    if count not in (1, images, poses):
        raise InputError(f"must be one, or {images}, one for each image" + f", or {poses}, one for each pose" * (poses > images)
                         + f": int32, got {shown(world)} and {geometry.n_worlds} worlds", argument="world")
    sensors.worlds.root = snapshot.roots
    sensors.world_image, sensors.world_pose = int(count == images > 1), int(count == poses > images)
    return geometry.n_worlds > 1 or world is not None


@made_once
def sensor_kernel(structure: Structure) -> Kernel:
    return kernels.make_sensor_kernel(structure.struct, structure.traversal(any_hit=False))


def trace_images(snapshot: Snapshot, sensors: WarpStruct, target: WarpStruct, wanted: Collection[str], n: int, worlds: bool,
                 threads: int | None) -> None:
    """Trace n rays and write the images `wanted` of `target`, from `images_of`. sensors: kernels.shade.sensors.Sensors."""
    if n > MOST_PACKED:
        raise InputError(f"{n} pixels are more than a call can trace, {MOST_PACKED}", argument="poses")
    surfaces, object_ids, device = snapshot.surfaces, ObjectIds(), snapshot.device
    if at_hits := [name for name in AT_HITS if name in wanted]:
        scene = device_scene(snapshot)
        for name in at_hits:
            require(scene.scene, name)
        if "point" in wanted or "normal" in wanted:
            scene.follow(snapshot)
        surfaces, object_ids = scene.surfaces, scene.object_ids
    if snapshot.geometry.origin is not None and ("point" in wanted or "origin" in wanted):
        raise InputError("points of a structure far from 0 are not within float32", argument="out", hint="use depth and range")
    count = thread_count(threads)
    if device.is_cuda or not has_stream(snapshot.structure):
        launch_on(device, sensor_kernel(snapshot.structure), n, snapshot.data, surfaces, object_ids, sensors, target, None,
                  threads=count, step=RAYS_PER_LAUNCH, captured=True)
        return
    shared = (world_tracer if worlds else tracer)(snapshot.structure, False)
    if captures_on_cpu():
        _record(snapshot, shared, (surfaces, object_ids, sensors, target), n)
        return
    step = min(BUFFERED, max(SMALL, -(-n // (4 * count * shared.block)) * shared.block))
    run_all([partial(_trace_block, snapshot, shared, (surfaces, object_ids, sensors, target), first, min(first + step, n))
             for first in range(0, n, step)], count)


def _trace_block(snapshot: Snapshot, shared: Tracer, inputs: tuple[WarpStruct, ...], first: int, end: int) -> None:
    """Make the rays first .. end - 1, at most BUFFERED, in a worker's buffers, trace them, and show their hits."""
    worker, threads = shared.workers.take(), -(-(end - first) // int(kernels.RAYS))
    rays = struct_record(WorldRays, worker.rays)
    launch_raw(kernels.make_rays, threads, inputs[2], rays, first, end)
    worker.launch(snapshot, worker.packed, 0, end - first)
    launch_raw(kernels.show_hits, threads, *inputs, rays, worker.packed[1], first, end)
    shared.workers.give(worker)


def _record(snapshot: Snapshot, shared: Tracer, inputs: tuple[WarpStruct, ...], n: int) -> None:
    """Record `_trace_block` of all rays in the graph that is captured on the CPU, with buffers of its own."""
    shape, cpu = min(n, BUFFERED), snapshot.device
    kinds = fields_of(WorldRays) | fields_of(HitArrays)
    made = {name: wp.empty(shape, dtype=kind.dtype, device=cpu) for name, kind in kinds.items()}
    arrays, hits = [made[name] for name in fields_of(WorldRays)], filled(HitArrays, [made[name] for name in fields_of(HitArrays)])
    rays, own, scratch = filled(WorldRays, arrays), filled(shared.rays, arrays), new_scratch(shared.sizes)
    for first in range(0, n, BUFFERED):
        end = min(first + BUFFERED, n)
        threads = -(-(end - first) // int(kernels.RAYS))
        launch_on(cpu, kernels.make_rays, threads, inputs[2], rays, first, end, captured=True)
        launch_on(cpu, shared.kernel, 1, snapshot.data, snapshot.surfaces, own, hits, scratch, 0, end - first, captured=True)
        launch_on(cpu, kernels.show_hits, threads, *inputs, rays, hits, first, end, captured=True)
