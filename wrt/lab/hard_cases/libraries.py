"""Each ray library as one function: closest_hit(vertices, faces, origins, directions) -> t, prim_id."""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.lab.hard_cases.common import surface
from wrt.lab.hard_cases.conformance import ClosestHit
from wrt.lab.hard_cases.contestants import Embree, EmbreeFast, Open3D, Peer, WarpMesh
from wrt.lab.mitsuba.process import require_llvm
from wrt.lab.mitsuba.shapes import Triangles, make_mesh
from wrt.lab.mitsuba.translate import mitsuba

TRIMESH_RAYS = 64  # rays a call; trimesh gathers all triangles in a box around each ray, which takes much memory

Answer = tuple[np.ndarray, np.ndarray]


def peer(kind: type[Peer], vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Hits:
    """Return the closest hits of a Peer."""
    algorithm = kind()
    algorithm.prepare(surface(vertices, faces))
    return algorithm.closest(origins, directions)


def mitsuba_closest(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Answer:
    """Return the closest hits of Mitsuba's variant llvm_ad_rgb, which uses Embree."""
    require_llvm()
    with mitsuba("llvm_ad_rgb") as mi:
        mesh = make_mesh(mi, "mesh", Triangles(vertices, faces, None, None), {})
        scene = mi.load_dict({"type": "scene", "mesh": mesh})
        rays = mi.Ray3f(mi.Point3f(origins.T.copy()), mi.Vector3f(directions.T.copy()))
        hits = scene.ray_intersect_preliminary(rays)
        return np.array(hits.t), np.where(np.array(hits.is_valid()), np.array(hits.prim_index).astype(np.int64), -1)


def trimesh_closest(vertices: np.ndarray, faces: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> Answer:
    """Return the closest hits of trimesh's own intersector, which computes in float64 with NumPy and does not use Embree."""
    import trimesh
    from trimesh.ray.ray_triangle import RayMeshIntersector

    intersector = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    t, prim_id = np.full(len(origins), np.inf), np.full(len(origins), -1)
    for first in range(0, len(origins), TRIMESH_RAYS):
        o, d = (rays[first:first + TRIMESH_RAYS].astype(np.float64) for rays in (origins, directions))
        face, ray, where = intersector.intersects_id(o, d, multiple_hits=False, return_locations=True)
        if len(ray):
            t[first + ray] = ((where - o[ray]) * d[ray]).sum(axis=1) / (d[ray] ** 2).sum(axis=1)
            prim_id[first + ray] = face
    return t, prim_id


@dataclass(frozen=True)
class Library:
    """A ray library. name: for tables; needs: packages that closest_hit imports."""

    name: str
    closest_hit: ClosestHit
    needs: Sequence[str] = ()


LIBRARIES = {
    "wrt": Library("wrt", lambda vertices, faces, origins, directions: build((vertices, faces)).closest_hit(origins, directions)),
    "embree": Library("Embree, robust", partial(peer, Embree), ["embreex"]),
    "embree_fast": Library("Embree, fast", partial(peer, EmbreeFast), ["embreex"]),
    "open3d": Library("Open3D", partial(peer, Open3D), ["open3d"]),
    "warp": Library("Warp", partial(peer, WarpMesh)),
    "mitsuba": Library("Mitsuba", mitsuba_closest, ["mitsuba"]),
    "trimesh": Library("trimesh", trimesh_closest, ["rtree"]),
}


def usable(name: str) -> str:
    """Return the reason why a library cannot be used on this machine, or "" if it can."""
    missing = [package for package in LIBRARIES[name].needs if importlib.util.find_spec(package) is None]
    if missing:
        return f"not installed: {', '.join(missing)}"
    if name == "mitsuba":
        try:
            require_llvm()
        except InputError as error:
            return str(error)
    return ""
