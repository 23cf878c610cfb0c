"""Documented calls, with the types that type checkers must infer for their results. The file is checked, never run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, assert_type

import numpy as np
import numpy.typing as npt
import warp as wp

import wrt
from wrt.accel.base import OneMesh
from wrt.accel.instances import Instances
from wrt.accel.points.closest_points import ClosestPoints
from wrt.accel.queries.all_hits import AllHits
from wrt.accel.queries.answers import Counters, Hits
from wrt.accel.queries.gradients import Gradients
from wrt.accel.snapshot import AccelStats, Refit
from wrt.core.types import WarpArray
from wrt.lab.rtcore.profiler import Profile
from wrt.scene.shapes import box, icosphere

Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]


def structures(mesh: wrt.Mesh, scene: wrt.Scene, name: str) -> None:
    assert_type(wrt.build((mesh.vertices, mesh.faces), "bvh2", max_leaf=2), OneMesh)
    assert_type(wrt.build(mesh, name, threads=2), OneMesh)
    assert_type(wrt.build(scene), OneMesh | Instances)
    assert_type(wrt.build(Path("bunny.ply"), device="cuda:0"), OneMesh | Instances)
    accel = wrt.build(mesh)
    accel.save("bunny.accel")
    assert_type(wrt.load_accel("bunny.accel", mesh), OneMesh)
    assert_type(accel.refit(1.1 * mesh.vertices, rebuild_at=1.5), Refit)
    assert_type(accel.stats, AccelStats)


def worlds(origins: Array, directions: Array) -> None:
    accel = wrt.build([icosphere(3), box(), icosphere(2)])
    assert_type(accel, Instances)
    hits = accel.closest_hit(origins, directions, world=np.arange(len(origins)) % 3)
    assert_type(hits, Hits)
    assert_type(accel.move(0, np.diag([2.0, 2.0, 2.0, 1.0])), Refit)
    assert_type(accel.move(object=0, world=2, matrix=np.eye(4)), Refit)
    robot = wrt.build(wrt.Scene.of([box(), icosphere(2)]), movable=True)
    assert_type(robot, Instances)
    assert_type(robot.move("arm", np.eye(4)), Refit)
    assert_type(robot.move(object="arm", matrix=np.eye(4), rebuild_at=2.0), Refit)


def queries(accel: OneMesh, origins: Array, directions: Array) -> None:
    hits = accel.closest_hit(origins, directions, counters=True)
    assert_type(hits.t, Array)
    assert_type(hits.point, Array)
    assert_type(hits.counters, Counters | None)
    assert_type(accel.closest_hit([[0.0, 0.0, 5.0]], [[0.0, 0.0, -1.0]], 0.0, 10.0, out=hits), Hits)
    assert_type(accel.any_hit(origins, directions, t_max=5.0), Bools)
    assert_type(hits.gradients(t=2.0 * hits.t), Gradients)
    assert_type(hits.gradients().vertices, Array)
    assert_type(hits.warp(), Hits[WarpArray])
    assert_type(hits[hits.hit], Hits)
    assert_type(hits[10:20].distance, Array)
    assert_type(accel.closest_hit((0.0, 0.0, 5.0), directions, invalid="miss"), Hits)
    hit = hits.prim_id >= 0
    wrt.visible(accel, hits.point[hit], origins[hit], on_a=hits.prim_id[hit])
    assert_type(wrt.visible(accel, origins, directions), Bools)
    found = wrt.all_hits(accel, origins, directions)
    assert_type(found, AllHits)
    assert_type(found.t[found.first[0] : found.first[1]], Array)
    assert_type(wrt.first_hits(accel, 4, origins, directions).prim_id, Array)
    assert_type(wrt.count_hits(accel, origins, directions, crossings=True), npt.NDArray[np.int64])
    assert_type(wrt.contains(accel, origins), Bools)
    assert_type(wrt.winding_number(accel, origins), npt.NDArray[np.float64])
    assert_type(wrt.closest_points(accel, origins), ClosestPoints)


def warp_queries(accel: OneMesh, origins: WarpArray, directions: WarpArray) -> None:
    hits = accel.closest_hit(origins, directions)
    assert_type(hits, Hits[WarpArray])
    assert_type(hits.normal, WarpArray)
    assert_type(hits.numpy().normal, Array)
    assert_type(accel.any_hit(origins, directions), WarpArray)
    accel.refit(hits.point, in_place=True)
    wrt.build(wrt.DeviceGeometry(origins, wp.zeros(12, dtype=wp.int32)), "bvh2", builder="lbvh")


class Tensor:
    """A tensor of any library with DLPack."""

    def __len__(self) -> int: ...  # type: ignore[empty-body]
    def __getitem__(self, index: Any, /) -> Tensor: ...  # type: ignore[empty-body]
    def __dlpack__(self, *, stream: int | None = None) -> object: ...
    def __dlpack_device__(self) -> tuple[int, int]: ...  # type: ignore[empty-body]


def tensors(accel: OneMesh, origins: Tensor, directions: Tensor) -> None:
    assert_type(accel.closest_hit(origins, directions), Hits[Tensor])
    assert_type(accel.any_hit(origins, directions), Tensor)
    assert_type(wrt.all_hits(accel, origins, directions).t, Tensor)
    assert_type(wrt.contains(accel, origins), Tensor)


def pictures() -> None:
    camera = wrt.load_scene("scenes/whitted.toml").camera()
    assert_type(wrt.camera_rays(camera, "640x360")[0], Array)
    film = wrt.render("scenes/whitted.toml", spp=64, size="640x360", camera=camera)
    assert_type(film, wrt.Film)
    film.save("whitted.png")
    assert_type(wrt.profile("scenes/whitted.toml", size="320x180", accel="bvh4"), Profile)
