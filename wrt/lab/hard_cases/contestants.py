"""What is put to the hard cases: wrt's own tests through the BVH, and the ray queries of other libraries (peers)."""

from __future__ import annotations

import importlib.util
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from wrt.accel.answers import Hits
from wrt.accel.base import Accelerator
from wrt.accel.build import build
from wrt.accel.geometry import Geometry
from wrt.core.errors import InputError


class Algorithm(ABC):
    """A way to find closest hits. prepare() once a geometry, then closest() on one thread."""

    name: str
    bytes_per_triangle: float = float("nan")
    is_peer: ClassVar[bool] = False
    package: ClassVar[str] = ""  # what a peer imports

    @classmethod
    def is_installed(cls) -> bool:
        return not cls.package or importlib.util.find_spec(cls.package) is not None

    @abstractmethod
    def prepare(self, geometry: Geometry) -> bool:
        """Build for this geometry; False where the library cannot take it (spheres)."""

    @abstractmethod
    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: Any = 0.0, t_max: Any = np.inf) -> Hits:
        """As wrt.accel.base.Accelerator.closest_hit."""


class Own(Algorithm):
    """wrt's BVH with one triangle test and one box test."""

    accel: Accelerator | None = None

    def __init__(self, triangle: str = "watertight", box: str = "conservative") -> None:
        self.triangle, self.box = triangle, box
        self.name = triangle if box == "conservative" else f"{triangle}, {box} boxes"

    def prepare(self, geometry: Geometry) -> bool:
        if self.accel is None or self.accel.geometry is not geometry:
            self.accel = build(geometry, "bvh", triangle=self.triangle, box=self.box, threads=1)
        self.bytes_per_triangle = self.accel.stats.bytes / max(len(geometry), 1)
        return True

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: Any = 0.0, t_max: Any = np.inf) -> Hits:
        assert self.accel is not None  # prepare() comes first
        return self.accel.closest_hit(origins, directions, t_min, t_max, threads=1)


class Peer(Algorithm):
    """Another library: triangles only. Segments are cut after the query where it has no t_min."""

    is_peer = True

    def prepare(self, geometry: Geometry) -> bool:
        if len(geometry.spheres) or not len(geometry.faces):
            return False
        self.load(geometry)
        return True

    @abstractmethod
    def load(self, geometry: Geometry) -> None:
        """Take the triangles."""


class Embree(Peer):
    """Embree 4 through embreex in its robust mode (RTC_SCENE_FLAG_ROBUST), which embreex also takes unasked from 4.4 on."""

    name = "Embree robust"
    package = "embreex"
    robust: ClassVar[bool] = True

    def load(self, geometry: Geometry) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise InputError(f'embreex is not usable ({error}); pip install "wrt[peers]" installs it') from error
        try:
            self.scene = EmbreeScene(robust=self.robust)
        except TypeError as error:
            raise InputError('embreex is too old to be asked for a mode; pip install "embreex>=4.4"') from error
        self.mesh = TriangleMesh(self.scene, geometry.vertices, geometry.faces)

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: Any = 0.0, t_max: Any = np.inf) -> Hits:
        out = self.scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=True)
        prim_id = out["primID"].astype(np.int32)
        return _cut(out["tfar"], prim_id, out["u"], out["v"], t_min, t_max)


class EmbreeFast(Embree):
    """Embree 4 through embreex without its robust flag: what Embree itself does unasked, and faster. It loses rays at edges."""

    name = "Embree fast"
    robust = False


class WarpMesh(Peer):
    """Warp's own mesh_query_ray on wp.Mesh with its SAH constructor. It says where, but not at which t below 0."""

    name = "Warp mesh_query_ray"

    def load(self, geometry: Geometry) -> None:
        import warp as wp

        from wrt.core.device import start

        self.device = start("cpu")
        points = wp.array(geometry.vertices.copy(), dtype=wp.vec3, device=self.device)
        indices = wp.array(geometry.faces.ravel().copy(), dtype=wp.int32, device=self.device)
        self.mesh = wp.Mesh(points=points, indices=indices, bvh_constructor="sah")

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: Any = 0.0, t_max: Any = np.inf) -> Hits:
        import warp as wp

        from wrt.kernels.study.peers import warp_mesh_query

        n = len(origins)
        length = np.linalg.norm(directions.astype(np.float64), axis=1)
        rays = [wp.array(np.ascontiguousarray(x, np.float32), dtype=wp.vec3, device=self.device)
                for x in (origins, directions / length[:, None])]
        t, u, v = (wp.zeros(n, dtype=wp.float32, device=self.device) for _ in range(3))  # a miss leaves u and v as they are
        prim_id = wp.empty(n, dtype=wp.int32, device=self.device)
        wp.launch(warp_mesh_query, dim=n, inputs=[self.mesh.id, *rays, t, u, v, prim_id], device=self.device)
        # Warp's u and v belong to the first two corners; wrt's to the last two.
        told = (t.numpy() / length).astype(np.float32)
        return _cut(told, prim_id.numpy(), v.numpy(), 1.0 - u.numpy() - v.numpy(), t_min, t_max)


class Open3D(Peer):
    """Open3D's RaycastingScene, which is Embree in its robust mode."""

    name = "Open3D RaycastingScene"
    package = "open3d"

    def load(self, geometry: Geometry) -> None:
        import open3d

        self.tensor = open3d.core.Tensor.from_numpy
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(self.tensor(geometry.vertices.copy()), self.tensor(geometry.faces.astype(np.uint32)))
        self.none = self.scene.INVALID_ID

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: Any = 0.0, t_max: Any = np.inf) -> Hits:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        told = {name: array.numpy() for name, array in self.scene.cast_rays(self.tensor(rays), nthreads=1).items()}
        prim_id = np.where(told["primitive_ids"] == self.none, -1, told["primitive_ids"].astype(np.int64)).astype(np.int32)
        u, v = told["primitive_uvs"].T
        return _cut(told["t_hit"], prim_id, u, v, t_min, t_max)


def _cut(t: np.ndarray, prim_id: np.ndarray, u: np.ndarray, v: np.ndarray, t_min: Any, t_max: Any) -> Hits:
    outside = (prim_id < 0) | ~((t >= t_min) & (t <= t_max))
    return Hits(np.where(outside, np.float32(np.inf), t), np.where(outside, 0, u), np.where(outside, 0, v),
                np.where(outside, np.int32(-1), prim_id))


def own_algorithms() -> list[Own]:
    """Every triangle test with conservative boxes, and the default test with every other box test."""
    from wrt.kernels.units.box import RAY_AABB
    from wrt.kernels.units.triangle import RAY_TRIANGLE

    return [Own(triangle) for triangle in RAY_TRIANGLE] + [Own(box=box) for box in RAY_AABB if box != "conservative"]


PEERS: dict[str, type[Peer]] = {"embree": Embree, "embree_fast": EmbreeFast, "warp": WarpMesh, "open3d": Open3D}
