"""Contestants: the structures of wrt and the ray libraries that measurements compare.

A contestant is named by a structure or a library, with options after colons: "bvh8", "bvh2:builder=sweep", "bvh8:triangle=plane",
"embree:mode=fast". Structures have the options of `wrt.build`. Installed packages add libraries by entry points (`wrt.contestants`)."""

import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import warp as wp

from wrt.accel.bvh.wide import CollapsedBvh
from wrt.accel.geometry import Geometry
from wrt.accel.points.closest_points import closest_points
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.accel.snapshot import check_units
from wrt.accel.structures import ACCELERATORS, options_of
from wrt.core.checks import as_choice, assigned, require_known
from wrt.core.device import load_kernel, start
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.registry import Registry
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.types import ArrayLike
from wrt.kernels.study.peers import warp_mesh_any, warp_mesh_query, warp_worlds_query
from wrt.lab.bench.rays import RaySet
from wrt.scene.mesh import Mesh

Triangles = Mesh | Geometry
RAYS = frozenset({"closest", "any"})


class Contestant(ABC):
    """An algorithm that answers rays. Call `prepare` for each geometry, then `closest`, or `search` to time it.

    device: only contestants with `on_gpu` accept another than "cpu". options: values for the names in OPTIONS."""

    NAME: ClassVar[str]  # key of the table
    OPTIONS: ClassVar[Mapping[str, tuple[str, ...]]] = {}  # option -> its values, the default first
    FAMILY: ClassVar[str] = ""  # library of which this is a mode; reports also show the best of its modes
    package: str = ""  # that a library imports
    queries: frozenset[str] = RAYS  # what it answers: closest, any, points, tiles
    has_threads = False  # `search` can use several threads
    on_gpu = False
    facts: dict[str, Any] = {}  # further fields of its rows in a report

    def __init__(self, device: str = DEFAULT_DEVICE, **options: Any) -> None:
        for option, value in options.items():
            require_known(option, self.OPTIONS, f"option of {self.NAME}", "contestants")
            as_choice(value, self.OPTIONS[option], f"contestants: {option}")
        if device != "cpu" and not self.on_gpu:
            raise InputError(f"{self.NAME} runs on the CPU only, not on {device}", argument="contestants")
        self.device = device
        self.options: dict[str, Any] = {option: values[0] for option, values in self.OPTIONS.items()} | options
        self.name = ":".join([self.NAME, *(f"{option}={value}" for option, value in options.items())])

    def missing(self) -> str:
        """Return the reason why this contestant cannot be used on this machine, or ""."""
        absent = self.package and importlib.util.find_spec(self.package) is None
        return f"not installed: {self.package}" if absent else ""

    def require(self) -> None:
        """Raise InputError if this contestant cannot be used on this machine."""
        if reason := self.missing():
            raise InputError(f"{self.name} cannot be used ({reason})", argument="contestants", hint='pip install "wrt[peers]"')

    def prepare(self, geometry: Geometry) -> bool:
        """Build the structure for a geometry; return False if the library does not support the geometry, for example spheres."""
        if len(geometry.spheres) or not len(geometry.faces):
            return False
        self.load(geometry)
        return True

    @abstractmethod
    def load(self, geometry: Geometry) -> None:
        """Pass the triangles to the library, and build its structure."""

    def load_worlds(self, worlds: Sequence[Mesh]) -> None:
        """Build structures for the kind of query "tiles"."""
        raise NotImplementedError

    @abstractmethod
    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        """Return closest hits, found by one thread; arguments and result as for Accelerator.closest_hit.
        A library may have no t_min and t_max: then hits outside are removed after the query."""

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        """Return the function to time: it answers the rays, with rays and results in the library's own arrays."""
        return lambda: self.closest(rays.origins, rays.directions, 0.0, rays.t_max)

    def result(self, out: Any) -> np.ndarray:
        """Return flags of the occluded rays, distances to closest points, or t of tiles. out: result of the function from search()."""
        return out.prim_id >= 0 if isinstance(out, Hits) else np.asarray(out)


class Own(Contestant):
    """A structure of wrt with the options of `wrt.build`."""

    has_threads = on_gpu = True

    def __init__(self, structure: str = "bvh", device: str = DEFAULT_DEVICE, **options: Any) -> None:
        kind = ACCELERATORS[structure]
        units = {name: options[name] for name in ("triangle", "box") if name in options}
        check_units(options.get("triangle", "watertight"), options.get("box", "conservative"))
        options_of(kind.name, kind.options, {name: value for name, value in options.items() if name not in units})
        self.NAME, self.OPTIONS = kind.name, {}  # type: ignore[misc]
        super().__init__(device)
        self.options, self.units = options, units
        wide = issubclass(kind, CollapsedBvh) and units.get("triangle", "watertight") == "watertight"
        self.queries = RAYS | {"tiles"} | ({"points"} if wide else set())  # as wrt.closest_points requires
        self.name = ":".join([kind.name, *(f"{option}={value}" for option, value in options.items())])

    def load(self, geometry: Geometry) -> None:
        self.accel: Any = build(geometry, self.NAME, self.device, **self.options)

    def prepare(self, geometry: Geometry) -> bool:
        if not hasattr(self, "accel") or self.accel.geometry is not geometry:
            self.load(geometry)
        return True

    def load_worlds(self, worlds: Sequence[Mesh]) -> None:
        self.accel = build(list(worlds), self.NAME, self.device, **self.options)

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        found: Hits = self.accel.closest_hit(origins, directions, t_min, t_max, threads=1)
        return found

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        accel = self.accel
        if rays.kind == "points":
            return lambda: closest_points(accel, rays.origins, threads).distance
        origins, directions = (wp.array(rows, dtype=wp.vec3, device=self.device) for rows in (rays.origins, rays.directions))
        t_max = wp.array(rays.t_max, dtype=wp.float32, device=self.device)
        world = {} if rays.world is None else {"world": wp.array(rays.world, dtype=wp.int32, device=self.device)}
        ask = accel.any_hit if rays.any_hit else accel.closest_hit
        return lambda: ask(origins, directions, 0.0, t_max, threads=threads, **world)

    def result(self, out: Any) -> np.ndarray:
        return np.asarray(out.t.numpy() if hasattr(out, "t") else out.numpy().astype(bool) if isinstance(out, wp.array) else out)


class Embree(Contestant):
    """Embree 4 through embreex, one ray at a time. mode: robust (RTC_SCENE_FLAG_ROBUST), or fast, which loses rays at edges."""

    NAME, package = "embree", "embreex"
    OPTIONS = {"mode": ("robust", "fast")}

    def load(self, geometry: Geometry) -> None:
        with needed_by(self.name):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        self.scene = EmbreeScene(robust=self.options["mode"] == "robust")
        self.mesh = TriangleMesh(self.scene, geometry.vertices, geometry.faces)
        self.closest(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # Embree builds at the first query

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        out = self.scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=True)
        return cut(out["tfar"], out["primID"].astype(np.int32), out["u"], out["v"], t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        o, d = np.ascontiguousarray(rays.origins), np.ascontiguousarray(rays.directions)
        if rays.any_hit:
            return lambda: self.scene.run(o, d, dists=rays.t_max, query="OCCLUDED")
        return lambda: self.scene.run(o, d, query="INTERSECT")

    def result(self, out: Any) -> np.ndarray:
        return np.asarray(out >= 0)


class WarpMesh(Contestant):
    """Warp's mesh_query_ray on a wp.Mesh. constructor: builder of Warp's BVH."""

    NAME = "warp"
    OPTIONS = {"constructor": ("sah", "median", "lbvh", "cubql")}
    FAMILY = "warp"
    queries = RAYS | {"tiles"}
    on_gpu = True

    def mesh_of(self, mesh: Triangles) -> wp.Mesh:
        place = start(self.device)
        return wp.Mesh(points=wp.array(mesh.vertices.copy(), dtype=wp.vec3, device=place), bvh_constructor=self.options["constructor"],
                       indices=wp.array(mesh.faces.ravel().copy(), dtype=wp.int32, device=place))

    def load(self, geometry: Geometry) -> None:
        self.meshes = [self.mesh_of(geometry)]

    def load_worlds(self, worlds: Sequence[Mesh]) -> None:
        self.meshes = [self.mesh_of(mesh) for mesh in worlds]

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        t, prim_id, u, v = (array.numpy() for array in self.search(RaySet("", origins, directions, np.ones(len(origins))), 1)())
        length = np.linalg.norm(directions.astype(np.float64), axis=1)
        # Warp's u and v are the weights of the first two corners; wrt's u and v are the weights of the last two.
        return cut((t / length).astype(np.float32), prim_id, v, 1.0 - u - v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        """Return the function to time. Warp requires unit directions, so the t_max of any-hit rays is converted to a distance."""
        n, place = len(rays), start(self.device)
        length = np.linalg.norm(rays.directions.astype(np.float64), axis=1)
        rows = [wp.array(np.ascontiguousarray(x, np.float32), dtype=wp.vec3, device=place)
                for x in (rays.origins, rays.directions / length[:, None])]
        reach = wp.array(np.minimum(rays.t_max * length, 1e38).astype(np.float32), dtype=wp.float32, device=place)
        first, results = self.meshes[0].id, [wp.float32, wp.int32, wp.float32, wp.float32]
        kernel, inputs = warp_mesh_query, [first, *rows]
        if rays.any_hit:
            kernel, inputs, results = warp_mesh_any, [first, *rows, reach], [wp.bool]
        elif rays.world is not None:
            ids = wp.array([mesh.id for mesh in self.meshes], dtype=wp.uint64, device=place)
            inputs = [ids, wp.array(rays.world, dtype=wp.int32, device=place), *rows]
            kernel, results = warp_worlds_query, results[:2]
        load_kernel(kernel, place)

        def run() -> list[wp.array]:
            out = [wp.zeros(n, dtype=dtype, device=place) for dtype in results]
            wp.launch(kernel, dim=n, inputs=[*inputs, *out], device=place)
            return out

        return run

    def result(self, out: Any) -> np.ndarray:
        return np.asarray(out[0].numpy())


class Open3D(Contestant):
    """Open3D's RaycastingScene, which is Embree in its robust mode."""

    NAME = package = "open3d"
    queries = RAYS | {"points"}
    has_threads = True

    def load(self, geometry: Geometry) -> None:
        import open3d

        self.tensor = open3d.core.Tensor.from_numpy
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(self.tensor(geometry.vertices.copy()), self.tensor(geometry.faces.astype(np.uint32)))

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        found = {name: array.numpy() for name, array in self.scene.cast_rays(self.tensor(rays), nthreads=1).items()}
        face = found["primitive_ids"].astype(np.int64)
        prim_id = np.where(face == self.scene.INVALID_ID, -1, face).astype(np.int32)
        u, v = found["primitive_uvs"].T
        return cut(found["t_hit"], prim_id, u, v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        if rays.kind == "points":
            return lambda: self.distances(rays.origins, threads)
        bundle = self.tensor(np.concatenate([rays.origins, rays.directions], axis=1))
        if rays.any_hit:
            return lambda: self.scene.test_occlusions(bundle, tnear=0.0, tfar=1.0, nthreads=threads)
        return lambda: self.scene.cast_rays(bundle, nthreads=threads)

    def distances(self, points: np.ndarray, threads: int) -> np.ndarray:
        found = self.scene.compute_closest_points(self.tensor(points), nthreads=threads)["points"].numpy()
        return np.asarray(np.sqrt(((found.astype(np.float64) - points) ** 2).sum(axis=1)))

    def result(self, out: Any) -> np.ndarray:
        return np.asarray(out if isinstance(out, np.ndarray) else out.numpy().astype(bool))


class Trimesh(Contestant):
    """trimesh.ray. engine: embree, or numpy, its own intersector in float64. It has no t_max, so segments need the hits' locations."""

    NAME = "trimesh"
    OPTIONS = {"engine": ("embree", "numpy")}

    def __init__(self, device: str = DEFAULT_DEVICE, **options: Any) -> None:
        super().__init__(device, **options)
        self.queries = RAYS | ({"points"} if importlib.util.find_spec("rtree") else set())
        self.module, self.package, self.at_once = {
            "embree": ("ray_pyembree", "embreex", 1 << 30),
            "numpy": ("ray_triangle", "rtree", 64),  # gathers the triangles in a box around each ray, which takes much memory
        }[self.options["engine"]]

    def load(self, geometry: Geometry) -> None:
        with needed_by(self.name):
            import trimesh

            module = importlib.import_module(f"trimesh.ray.{self.module}")
        self.mesh = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
        self.rays = module.RayMeshIntersector(self.mesh)
        self.rays.intersects_first(np.zeros((1, 3)), np.ones((1, 3)))  # Embree builds at the first query

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        t, prim_id = np.full(len(origins), np.inf), np.full(len(origins), -1, np.int32)
        for first in range(0, len(origins), self.at_once):
            o, d = (rows[first:first + self.at_once].astype(np.float64) for rows in (origins, directions))
            face, ray, where = self.rays.intersects_id(o, d, multiple_hits=False, return_locations=True)
            if len(ray):
                t[first + ray] = ((where - o[ray]) * d[ray]).sum(axis=1) / (d[ray] ** 2).sum(axis=1)
                prim_id[first + ray] = face
        return cut(t, prim_id, None, None, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], Any]:
        o, d = rays.origins.astype(np.float64), rays.directions.astype(np.float64)
        if rays.kind == "points":
            import trimesh

            return lambda: trimesh.proximity.closest_point(self.mesh, o)[1]
        if not rays.any_hit:
            return lambda: self.rays.intersects_first(o, d)
        if np.isinf(rays.t_max).all():
            return lambda: self.rays.intersects_any(o, d)
        return super().search(rays, threads)


class MitsubaRays(Contestant):
    """Mitsuba's variant llvm_ad_rgb, which traces with Embree."""

    NAME = package = "mitsuba"

    def missing(self) -> str:
        from wrt.lab.mitsuba.translate import llvm_missing

        return super().missing() or llvm_missing()

    def load(self, geometry: Geometry) -> None:
        self.geometry = geometry

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        from wrt.lab.mitsuba.shapes import Triangles as Shape
        from wrt.lab.mitsuba.shapes import make_mesh
        from wrt.lab.mitsuba.translate import mitsuba

        with mitsuba("llvm_ad_rgb") as mi:
            mesh = make_mesh(mi, "mesh", Shape(self.geometry.vertices, self.geometry.faces, None, None), {})
            rays = mi.Ray3f(mi.Point3f(origins.T.copy()), mi.Vector3f(directions.T.copy()))
            hits = mi.load_dict({"type": "scene", "mesh": mesh}).ray_intersect_preliminary(rays)
            prim_id = np.where(np.array(hits.is_valid()), np.array(hits.prim_index).astype(np.int32), -1)
            return cut(np.array(hits.t), prim_id, None, None, t_min, t_max)


def cut(t: np.ndarray, prim_id: np.ndarray, u: np.ndarray | None, v: np.ndarray | None, t_min: ArrayLike, t_max: ArrayLike) -> Hits:
    """Return Hits in which hits outside [t_min, t_max] are misses. u, v: None if the library does not report them."""
    outside = (prim_id < 0) | ~((t >= np.asarray(t_min)) & (t <= np.asarray(t_max)))
    u, v = (None if each is None else np.where(outside, 0, each) for each in (u, v))
    return Hits(np.where(outside, np.float32(np.inf), t), u, v, np.where(outside, np.int32(-1), prim_id))  # type: ignore[arg-type]


LIBRARIES: Registry[type[Contestant]] = Registry("contestant", {
    kind.NAME: kind for kind in (Embree, WarpMesh, Open3D, Trimesh, MitsubaRays)}, "wrt.contestants", type)
RIVALS = ("embree", "embree:mode=fast", "open3d", "trimesh", "warp")  # the default rivals in a comparison of speed


def contestant(name: str, device: str = DEFAULT_DEVICE) -> Contestant:
    """Return the contestant that a name means. Raise InputError for an unknown name, option or value."""
    kind, *words = name.split(":")
    require_known(kind, [*ACCELERATORS, *LIBRARIES], "contestant", "contestants")
    options: dict[str, Any] = dict(assigned(words, "contestants"))
    return Own(kind, device, **options) if kind in ACCELERATORS else LIBRARIES[kind](device, **options)


def check_names(names: Sequence[str]) -> None:
    for name in names:
        contestant(name).require()


def installed(names: Sequence[str], device: str = "cpu") -> list[str]:
    """Return the libraries among `names` that can be used on this machine and device."""
    return [name for name in names if not contestant(name).missing() and (contestant(name).on_gpu or device == "cpu")]
