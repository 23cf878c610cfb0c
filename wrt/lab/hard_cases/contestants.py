"""Algorithms that find closest hits: wrt's intersection tests in its structures, and the queries of other libraries (peers)."""

import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from wrt.accel.base import Accelerator
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import BuildOptions, build
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.registry import Registry
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike
from wrt.lab.bench.rays import RaySet

CONSTRUCTORS = ("sah", "median", "lbvh", "cubql")  # builders of Warp's BVH


class Algorithm(ABC):
    """An algorithm that finds closest hits: call prepare() for each geometry, then closest(), which uses one thread."""

    name: str
    bytes_per_triangle: float = float("nan")  # size of the structure
    is_peer: ClassVar[bool] = False  # another library than wrt
    has_threads: ClassVar[bool] = True  # search() can use several threads
    package: ClassVar[str] = ""  # package that a peer imports

    @classmethod
    def is_installed(cls) -> bool:
        return not cls.package or importlib.util.find_spec(cls.package) is not None

    @abstractmethod
    def prepare(self, geometry: Geometry) -> bool:
        """Build the structure for a geometry; return False if the library does not support the geometry, for example spheres."""

    @abstractmethod
    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        """Return closest hits; arguments and result as for wrt.accel.base.Accelerator.closest_hit."""

    @abstractmethod
    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        """Return the function to time: it traces the rays, with rays and results in the library's own arrays."""

    def occluded(self, out: Any) -> np.ndarray:
        """Return flags of the occluded rays. out: result of the function from search(), for any-hit rays."""
        return out.numpy().astype(bool)


class Own(Algorithm):
    """A structure of wrt with one triangle test and one box test."""

    accel: Accelerator  # after prepare()

    def __init__(self, triangle: str = "watertight", box: str = "conservative", structure: str = "bvh",
                 device: str = DEFAULT_DEVICE) -> None:
        self.structure, self.device, self.units = structure, device, BuildOptions(triangle=triangle, box=box)
        self.name = triangle if box == "conservative" else f"{triangle}, {box} boxes"

    def prepare(self, geometry: Geometry) -> bool:
        if not hasattr(self, "accel") or self.accel.geometry is not geometry:
            self.accel = build(geometry, self.structure, self.device, threads=1, **self.units)
        self.bytes_per_triangle = self.accel.stats.bytes / max(len(geometry), 1)
        return True

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        return self.accel.closest_hit(origins, directions, t_min, t_max, threads=1)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        import warp as wp

        origins, directions = (wp.array(a, dtype=wp.vec3, device=self.device) for a in (rays.origins, rays.directions))
        t_max = wp.array(rays.t_max, dtype=wp.float32, device=self.device)
        ask = self.accel.any_hit if rays.any_hit else self.accel.closest_hit
        return lambda: ask(origins, directions, 0.0, t_max, threads=threads)


class Peer(Algorithm):
    """Another library, for triangles only. Hits outside [t_min, t_max] are removed after the query."""

    is_peer = True
    has_threads = False
    on_gpu: ClassVar[bool] = False  # it can trace on the device that the constructor names
    family: ClassVar[str] = ""  # of peers that are modes of one library: the reports also show the fastest of them

    @classmethod
    def modes(cls, device: str) -> "list[Peer]":
        """Return the peers to compare on this device."""
        return [cls()]

    def prepare(self, geometry: Geometry) -> bool:
        if len(geometry.spheres) or not len(geometry.faces):
            return False
        self.load(geometry)
        return True

    @abstractmethod
    def load(self, geometry: Geometry) -> None:
        """Pass the triangles to the library."""


class Embree(Peer):
    """Embree 4 through embreex in its robust mode (RTC_SCENE_FLAG_ROBUST), embreex's default from 4.4 on."""

    name = "Embree robust"
    package = "embreex"
    family = "Embree robust"
    robust: ClassVar[bool] = True

    def load(self, geometry: Geometry) -> None:
        with needed_by(self.name):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        try:
            self.scene = EmbreeScene(robust=self.robust)
        except TypeError as error:
            raise InputError("embreex is too old: it has no choice of the mode", hint='pip install "embreex>=4.4"') from error
        self.mesh = TriangleMesh(self.scene, geometry.vertices, geometry.faces)
        self.closest(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # Embree builds at the first query

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        out = self.scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=True)
        prim_id = out["primID"].astype(np.int32)
        return cut(out["tfar"], prim_id, out["u"], out["v"], t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        o, d = np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions)
        if rays.any_hit:
            return lambda: self.scene.run(o, d, dists=rays.t_max, query="OCCLUDED")
        return lambda: self.scene.run(o, d, query="INTERSECT")

    def occluded(self, out: Any) -> np.ndarray:
        return out >= 0


class EmbreeFast(Embree):
    """Embree 4 through embreex without the robust flag, which is Embree's own default: faster, but it loses rays at edges."""

    name = "Embree fast"
    family = ""
    robust = False


def constructors(device: str) -> tuple[str, ...]:
    """Return the builders of Warp's BVH to compare on this device: on the CPU the one with the fastest queries, on a GPU all."""
    return CONSTRUCTORS if device.startswith("cuda") else CONSTRUCTORS[:1]


class WarpMesh(Peer):
    """Warp's mesh_query_ray, which has no t_min, on a wp.Mesh built by one of Warp's constructors."""

    name = "Warp mesh_query_ray"
    family = "Warp mesh_query_ray"
    on_gpu = True

    @classmethod
    def modes(cls, device: str) -> list[Peer]:
        """Return one with each constructor."""
        return [cls(device, each) for each in constructors(device)]

    def __init__(self, device: str = DEFAULT_DEVICE, constructor: str = "sah") -> None:
        self.place, self.constructor = device, constructor
        if constructor != "sah":
            self.name = f"{type(self).name}, {constructor}"

    def load(self, geometry: Geometry) -> None:
        import warp as wp

        from wrt.core.device import start

        self.device = start(self.place)
        points = wp.array(geometry.vertices.copy(), dtype=wp.vec3, device=self.device)
        indices = wp.array(geometry.faces.ravel().copy(), dtype=wp.int32, device=self.device)
        self.mesh = wp.Mesh(points=points, indices=indices, bvh_constructor=self.constructor)

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        found: Any = self.search(RaySet("", origins, directions, np.ones(len(origins))), 1)()
        t, u, v, prim_id = (array.numpy() for array in found)
        length = np.linalg.norm(directions.astype(np.float64), axis=1)
        # Warp's u and v are the weights of the first two corners; wrt's u and v are the weights of the last two.
        return cut((t / length).astype(np.float32), prim_id, v, 1.0 - u - v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        """Return the function to time. Warp requires unit directions, so the t_max of any-hit rays is converted to a distance."""
        import warp as wp

        from wrt.core.device import load_kernel
        from wrt.kernels.study.peers import warp_mesh_any, warp_mesh_query

        n, device = len(rays), self.device
        length = np.linalg.norm(rays.directions.astype(np.float64), axis=1)
        inputs = [self.mesh.id, *(wp.array(np.ascontiguousarray(x, np.float32), dtype=wp.vec3, device=device)
                                  for x in (rays.origins, rays.directions / length[:, None]))]
        reach = wp.array(np.minimum(rays.t_max * length, 1e38).astype(np.float32), dtype=wp.float32, device=device)
        load_kernel(warp_mesh_any if rays.any_hit else warp_mesh_query, device)

        def any_hit() -> object:
            occluded = wp.empty(n, dtype=wp.bool, device=device)
            wp.launch(warp_mesh_any, dim=n, inputs=[*inputs, reach, occluded], device=device)
            return occluded

        def closest() -> object:
            out = [wp.zeros(n, dtype=dtype, device=device) for dtype in (wp.float32, wp.float32, wp.float32, wp.int32)]
            wp.launch(warp_mesh_query, dim=n, inputs=[*inputs, *out], device=device)
            return out

        return any_hit if rays.any_hit else closest


class Open3D(Peer):
    """Open3D's RaycastingScene, which is Embree in its robust mode."""

    name = "Open3D RaycastingScene"
    package = "open3d"
    has_threads = True

    def load(self, geometry: Geometry) -> None:
        import open3d

        self.tensor = open3d.core.Tensor.from_numpy
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(self.tensor(geometry.vertices.copy()), self.tensor(geometry.faces.astype(np.uint32)))
        self.none = self.scene.INVALID_ID

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        found = {name: array.numpy() for name, array in self.scene.cast_rays(self.tensor(rays), nthreads=1).items()}
        prim_id = np.where(found["primitive_ids"] == self.none, -1, found["primitive_ids"].astype(np.int64)).astype(np.int32)
        u, v = found["primitive_uvs"].T
        return cut(found["t_hit"], prim_id, u, v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        bundle = self.tensor(np.concatenate([rays.origins, rays.directions], axis=1))
        if rays.any_hit:
            return lambda: self.scene.test_occlusions(bundle, tnear=0.0, tfar=1.0, nthreads=threads)
        return lambda: self.scene.cast_rays(bundle, nthreads=threads)


class Trimesh(Peer):
    """trimesh.ray with Embree. It has no t_max, so segments need the hits' locations."""

    name = "trimesh.ray with embreex"
    package = "embreex"

    def load(self, geometry: Geometry) -> None:
        with needed_by(self.name):
            import trimesh
            from trimesh.ray.ray_pyembree import RayMeshIntersector

        self.mesh = RayMeshIntersector(trimesh.Trimesh(geometry.vertices, geometry.faces, process=False))
        self.mesh.intersects_first(np.zeros((1, 3)), np.ones((1, 3)))  # Embree builds at the first query

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        face, ray, where = self.mesh.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
        t, prim_id = np.full(len(origins), np.inf), np.full(len(origins), -1, np.int32)
        o, d = origins[ray].astype(np.float64), directions[ray].astype(np.float64)
        t[ray], prim_id[ray] = ((where - o) * d).sum(axis=1) / (d**2).sum(axis=1), face
        return cut(t.astype(np.float32), prim_id, np.zeros(len(t)), np.zeros(len(t)), t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        o, d = rays.origins.astype(np.float64), rays.directions.astype(np.float64)
        if not rays.any_hit:
            return lambda: self.mesh.intersects_first(o, d)
        if np.isinf(rays.t_max).all():
            return lambda: self.mesh.intersects_any(o, d)
        return lambda: self.closest(o, d, 0.0, rays.t_max).prim_id >= 0

    def occluded(self, out: np.ndarray) -> np.ndarray:
        return out


def cut(t: np.ndarray, prim_id: np.ndarray, u: np.ndarray, v: np.ndarray, t_min: ArrayLike, t_max: ArrayLike) -> Hits:
    """Return Hits in which hits outside [t_min, t_max] are misses."""
    outside = (prim_id < 0) | ~((t >= np.asarray(t_min)) & (t <= np.asarray(t_max)))
    return Hits(np.where(outside, np.float32(np.inf), t), np.where(outside, 0, u), np.where(outside, 0, v),
                np.where(outside, np.int32(-1), prim_id))


def own_algorithms() -> list[Own]:
    """Return every triangle test with conservative boxes, and the default triangle test with every other box test."""
    from wrt.kernels.units.box import RAY_AABB
    from wrt.kernels.units.triangle import RAY_TRIANGLE

    return [Own(triangle) for triangle in RAY_TRIANGLE] + [Own(box=box) for box in RAY_AABB if box != "conservative"]


PEERS: Registry[type[Peer]] = Registry("rival", {
    "embree": f"{__name__}:Embree",
    "embree_fast": f"{__name__}:EmbreeFast",
    "embree16": "wrt.lab.hard_cases.embree_packets:EmbreePackets",
    "embree16_incoherent": "wrt.lab.hard_cases.embree_packets:EmbreeIncoherentPackets",
    "warp": f"{__name__}:WarpMesh",
    "open3d": f"{__name__}:Open3D",
})
# Of `bench peers`: also those whose hits have no u and v.
RIVALS: Registry[type[Peer]] = Registry("rival", {**PEERS.data, "trimesh": f"{__name__}:Trimesh"})
