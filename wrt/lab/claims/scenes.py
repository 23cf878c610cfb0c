"""Scenes, cameras and workloads of the claims: path tracing, ambient occlusion and shadow rays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.core.checks import require_known
from wrt.core.errors import InputError
from wrt.core.types import PathLike
from wrt.io.mesh_file import as_mesh
from wrt.lab.bench.rays import OFFSET, ball_around, terrain, through_pixels, unit
from wrt.lab.claims.walks import Rays
from wrt.lab.rtcore.model import WARP, blocks
from wrt.scene.mesh import Mesh
from wrt.scene.shapes import box, icosphere, merged, torus, tube

BOUNCES = 3
INSIDE = ("sponza", "hall")  # Scenes that the camera sees from the middle of their box.
AO_RADIUS = 0.1  # Length of ambient occlusion rays over the radius of the scene's bounding sphere.
PATH, AO, SHADOW = "path tracing", "ambient occlusion", "shadow"


def statue() -> Mesh:
    """Return a closed surface with folds, 81,920 triangles: stands in for a scanned statue."""
    ball = icosphere(6)
    v = ball.vertices.astype(np.float64)
    folds = np.zeros(len(v))
    for k in (2, 4, 8, 16):
        folds += 0.5 / k * np.sin(k * (2.3 * v[:, 0] + 1.1 * v[:, 1]) + k) * np.cos(k * (1.7 * v[:, 2] - 0.8 * v[:, 1]))
    return Mesh(v * (1.0 + 0.35 * folds[:, None]) * [0.8, 1.0, 0.7], ball.faces, name="statue")


def hall() -> Mesh:
    """Return a hall with two storeys of columns, arches and folded cloths, about 90,000 triangles: stands in for an atrium."""
    parts = [box((-12.0, -0.2, -5.0), (12.0, 0.0, 5.0)), box((-12.0, 8.0, -5.0), (12.0, 8.2, -2.0)),
             box((-12.0, 8.0, 2.0), (12.0, 8.2, 5.0)),
             box((-12.0, 0.0, -5.2), (12.0, 8.0, -5.0)), box((-12.0, 0.0, 5.0), (12.0, 8.0, 5.2)),
             box((-12.2, 0.0, -5.0), (-12.0, 8.0, 5.0)), box((12.0, 0.0, -5.0), (12.2, 8.0, 5.0))]
    arch = torus(1.0, 0.12, 48, 12)
    for storey in (0.0, 4.0):
        for side in (-2.4, 2.4):
            for x in range(-10, 12, 2):
                column = [(float(x), storey + 0.15 * k, side) for k in range(19)]
                parts.append(tube(np.array(column), 0.16, 16))
                v = arch.vertices.astype(np.float64)[:, [0, 2, 1]] + [x + 1.0, storey + 2.8, side]
                parts.append(Mesh(v, arch.faces, name="arch"))
    grid = terrain(60)
    for i, x in enumerate(range(-8, 12, 4)):
        v = grid.vertices.astype(np.float64)
        cloth = np.stack([x + 0.9 * v[:, 0], 5.5 + 1.2 * v[:, 2], (-1) ** i * 1.6 + 0.5 * v[:, 1]], axis=1)
        parts.append(Mesh(cloth, grid.faces, name="cloth"))
    return merged([Mesh(each.vertices, each.faces, name=each.name) for each in parts], "hall")


# Name of a published scene -> the generated one that stands in for it, if the caller gives no file.
STAND_INS: dict[str, tuple[str, Callable[[], Mesh]]] = {"bunny": ("statue", statue), "sponza": ("hall", hall)}


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene. name: published name; shown: name in reports; given: whether it is the caller's file and no stand-in."""

    name: str
    shown: str
    given: bool
    mesh: Mesh
    side: int  # pixels of a side of the square picture

    @cached_property
    def geometry(self) -> Geometry:
        return Geometry.of(self.mesh)

    @cached_property
    def accel(self) -> OneMesh:
        return build(self.geometry, "bvh8")

    @property
    def inside(self) -> bool:
        """Whether camera and light are inside the scene's box."""
        return self.shown in INSIDE

    @cached_property
    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """Eye and target in world space: outside at 1.5 radii of the bounding sphere, or in the middle, along the longest horizontal
        axis."""
        lo, hi, center, radius = ball_around(self.geometry)
        if not self.inside:
            return center + 1.5 * radius * unit(np.array([0.6, 0.35, 0.8])), center
        axis = 0 if hi[0] - lo[0] >= hi[2] - lo[2] else 2
        ahead = np.array([0.15, -0.05, 0.15])
        ahead[axis] = 1.0
        eye = center - 0.25 * (hi - lo) * (np.arange(3) == axis)
        return eye, eye + ahead

    @cached_property
    def workloads(self) -> dict[str, Rays]:
        """Rays of PATH, AO and SHADOW: the camera's rays, and rays that start at their hits."""
        return {name: rays_of(self, name) for name in (PATH, AO, SHADOW)}


def open_scene(name: str, path: Mesh | PathLike | None, side: int) -> Scene:
    """Return the scene called `name` from a mesh file, or the generated one that stands in for it."""
    if path is not None:
        return Scene(name, name, True, as_mesh(path), side)
    shown, make = STAND_INS[name]
    return Scene(name, shown, False, make(), side)


def rays_of(scene: Scene, workload: str, seed: int = 0) -> Rays:
    """Return the rays of a workload, a picture with one sample a pixel. Equal arguments give equal rays.

    PATH: from each hit a shadow ray and, up to BOUNCES times, a diffuse ray. AO: one ray of cosine distribution and length AO_RADIUS.
    SHADOW: one ray to a point light, above the scene or, with the camera inside, below its ceiling. Warps are blocks of 8 x 4 pixels, each
    with the rays of one depth and kind."""
    lo, hi, center, radius = ball_around(scene.geometry)
    rng = np.random.default_rng(seed)
    light = center + (np.array([0.05, 0.4, 0.05]) * (hi - lo) if scene.inside else radius * np.array([0.8, 1.7, 0.6]))
    origins, directions = through_pixels(*scene.camera, scene.side)
    pixel = np.arange(len(origins))
    waves: list[Rays] = []

    def add(o: np.ndarray, d: np.ndarray, t_max: float, kind: int, depth: int) -> None:
        waves.append(in_warps(scene, Rays(o.astype(np.float32), d.astype(np.float32), np.full(len(o), t_max, np.float32),
                                          np.full(len(o), kind), np.full(len(o), depth), pixel, pixel)))

    for depth in range(BOUNCES + 1):
        add(origins, directions, np.inf, 0, depth)
        hits = scene.accel.closest_hit(origins.astype(np.float32), directions.astype(np.float32))
        hit = np.asarray(hits.prim_id) >= 0
        points, normals = surface(scene.geometry, origins[hit], directions[hit], hits.t[hit], hits.prim_id[hit])
        pixel, origins = pixel[hit], points + OFFSET * radius * normals
        bounce = unit(normals + 0.999 * unit(rng.normal(size=origins.shape)))
        if workload == AO:
            add(origins, AO_RADIUS * radius * bounce, 1.0, 1, depth)
            break
        add(origins, light - origins, 1.0, 1, depth)
        if workload == SHADOW:
            break
        directions = bounce
    offset = np.cumsum([0, *(int(wave.warp[-1]) + 1 if len(wave) else 0 for wave in waves[:-1])])
    fields = {name: np.concatenate([getattr(wave, name) for wave in waves]) for name in Rays.__dataclass_fields__ if name != "warp"}
    return Rays(**fields, warp=np.concatenate([wave.warp + first for wave, first in zip(waves, offset, strict=True)]))


def in_warps(scene: Scene, rays: Rays) -> Rays:
    """Sort rays by the warp and lane of their pixels, and number the warps that have a ray from 0 on."""
    warp, lane = blocks(scene.side, scene.side)
    order = np.argsort(warp[rays.pixel] * WARP + lane[rays.pixel], kind="stable")
    _, number = np.unique(warp[rays.pixel[order]], return_inverse=True)
    out = rays.part(order)
    out.warp[...] = number
    return out


def surface(geometry: Geometry, origins: np.ndarray, directions: np.ndarray, t: np.ndarray,
            prim_id: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return hit points and unit normals towards the rays' origins, (N, 3) float64 each; a triangle without area gets the ray's reverse."""
    corners = geometry.vertices[geometry.faces[prim_id]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    back = -unit(directions)
    normals = np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), back)
    normals = np.where((normals * back).sum(axis=1, keepdims=True) < 0.0, -normals, normals)
    return origins + t[:, None].astype(np.float64) * directions, normals


def scene_files(pairs: Sequence[str]) -> dict[str, str]:
    """Return the mesh file of each published scene from "name=file". Raise InputError for an unknown name, and without a file."""
    files = {}
    for pair in pairs:
        name, given, path = pair.partition("=")
        if not given or not path:
            raise InputError(f"{pair!r} names no file", argument="scene", hint=f"write {name or 'bunny'}=FILE")
        require_known(name, STAND_INS, "scene", "scene")
        files[name] = path
    return files
