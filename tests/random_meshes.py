"""Check every structure with random meshes and rays: `python -m tests.random_meshes --count 10000`.

All structures must return the bits of brute force, however the rays are passed: few or many a call, in orders with and without
packets, from NumPy or Warp. A case's group selects its kind of geometry (KINDS); `--only GROUP SEED` repeats a case.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
import warp as wp

import wrt
from tests import random_cases
from tests.random_rays import RAYS, Rays, at_their_hits, rays_of
from tests.structures import STRUCTURES
from wrt.accel.bvh.builders import BVH_BUILDERS
from wrt.accel.geometry import Geometry
from wrt.accel.scenes.flatten import flatten
from wrt.accel.scenes.instancing import instanced_meshes
from wrt.kernels.query import HitArrays, RayArrays, store_hit
from wrt.kernels.warp_private import fields_of
from wrt.scene import shapes
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene, Sphere

Rng = np.random.Generator
Triangles = np.ndarray  # (N, 3, 3) float64: corners.
PACKET = 16  # Rays.
PACKETS = 4  # Packets in a call: after more packets that fall apart, wrt traces the next rays without packets.
MANY = 1100, 1400  # Rays of a call: enough to be traced without copies of the arrays.

# --- meshes: around the origin, of size 1 -----------------------------------------------------------------------------


def soup(rng: Rng, n: int) -> Triangles:
    return rng.uniform(-1.0, 1.0, (n, 1, 3)) + rng.uniform(-1.0, 1.0, (n, 3, 3)) * 10.0 ** rng.uniform(-3.0, 0.0, (n, 1, 1))


def shared_corners(rng: Rng, n: int) -> Triangles:
    """Return triangles that share edges and corners; some are duplicates, some degenerate to points or lines."""
    corners = rng.uniform(-1.0, 1.0, (3 + n // 3, 3))
    return corners[rng.integers(0, len(corners), (n, 3))]


def grid(rng: Rng, n: int) -> Triangles:
    """Return a height field with integer heights, often flat: boxes without thickness, edges along the axes."""
    side = max(1, round((n / 2) ** 0.5))
    heights = rng.integers(0, rng.integers(1, 4), (side + 1, side + 1))
    x, y = np.mgrid[:side, :side].reshape(2, -1)
    a, b, c, d = (np.stack([x + i, y + j, heights[x + i, y + j]], axis=1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]) * (2.0 / side) - (1.0, 1.0, 0.0)


def stack(rng: Rng, n: int) -> Triangles:
    """Return parallel flat sheets, some at the same height."""
    sheets = [grid(rng, max(2, n // 5)) * (1.0, 1.0, 0.0) + (0.0, 0.0, z) for z in rng.integers(-2, 3, 5) / 4.0]
    return np.concatenate(sheets)


def slivers(rng: Rng, n: int) -> Triangles:
    """Return needles: n triangles, each close to a line."""
    begin, along = rng.uniform(-1.0, 1.0, (2, n, 1, 3))
    return begin + along * rng.uniform(-1.0, 1.0, (n, 3, 1)) + rng.normal(0.0, 10.0 ** rng.uniform(-8.0, -2.0), (n, 3, 3))


def fan(rng: Rng, n: int) -> Triangles:
    """Return triangles that share one corner, often all in one plane."""
    angle = np.linspace(0.0, 2.0 * np.pi, n + 3)
    rim = np.stack([np.cos(angle), np.sin(angle), rng.integers(0, 2) * rng.uniform(-0.5, 0.5, len(angle))], axis=1)
    return np.stack([np.zeros((n + 2, 3)), rim[:-1], rim[1:]], axis=1)


def of_shape(make: Callable[[], Mesh]) -> Callable[[Rng, int], Triangles]:
    return lambda rng, n: make().vertices.astype(np.float64)[make().faces]


MESHES: dict[str, Callable[[Rng, int], Triangles]] = {
    "soup": soup, "shared corners": shared_corners, "grid": grid, "stack": stack, "slivers": slivers, "fan": fan,
    "one": lambda rng, n: soup(rng, 1), "nothing": lambda rng, n: np.zeros((0, 3, 3)),
    "box": of_shape(shapes.box), "ball": of_shape(lambda: shapes.icosphere(2)),
    "torus": of_shape(lambda: shapes.torus(0.7, 0.3, 12, 8)),
}


def triangles(rng: Rng) -> Triangles:
    """Return one kind of MESHES or two together, faces shuffled, some turned over or duplicated, sometimes rotated."""
    size = [4, 30, 80, 600][rng.choice(4, p=[0.2, 0.4, 0.37, 0.03])]
    kinds = rng.choice([*MESHES], rng.integers(1, 3))
    out = np.concatenate([MESHES[kind](rng, int(rng.integers(1, size + 1))) for kind in kinds])
    if rng.random() < 0.3 and len(out):  # some twice
        out = np.concatenate([out, out[rng.integers(0, len(out), rng.integers(1, 9))]])
    out = rng.permutation(out)
    turned = rng.random(len(out)) < 0.2
    out[turned] = out[turned][:, ::-1]
    if rng.random() < 0.3:
        out = out @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    return out


def mesh_of(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) float32 and faces (F, 3) int32 of a mesh of random size and position."""
    corners = triangles(rng)
    if rng.random() < 0.3:
        corners = corners + rng.normal(size=3) * 10.0 ** rng.uniform(0.0, 4.0)
    if rng.random() < 0.3:
        corners = corners * 10.0 ** (rng.uniform(-12.0, 12.0) if rng.random() < 0.8 else rng.uniform(-44.0, -36.0))
    if len(corners) and rng.random() < 0.5:
        vertices, faces = np.unique(corners.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True)
        return vertices, faces.reshape(-1, 3).astype(np.int32)
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)


def balls(rng: Rng, vertices: np.ndarray) -> np.ndarray:
    """Return spheres within the box of the vertices: centre and radius, (S, 4) float32."""
    low, high = extent(vertices)
    centers = rng.uniform(low, high, (rng.integers(1, 9), 3))
    radii = np.max(high - low) * 10.0 ** rng.uniform(-2.0, 0.0, (len(centers), 1))
    return np.concatenate([centers, radii], axis=1).astype(np.float32)


def extent(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    good = vertices[np.isfinite(vertices).all(axis=1)].astype(np.float64)
    return (good.min(axis=0), good.max(axis=0)) if len(good) else (-np.ones(3), np.ones(3))


# --- kinds of geometry ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """The geometry and the rays of one case."""

    given: Any  # The argument of wrt.build.
    rays: Rays
    world: np.ndarray | None = None  # The world of each ray, (N,) int32; None: there is only one world.
    before: np.ndarray | None = None  # Vertices to build with, before a refit to the vertices of `given`; None: no refit.


def plain(rng: Rng) -> Case:
    vertices, faces = mesh_of(rng)
    before = None
    if rng.random() < 0.2 and len(faces):
        low, high = extent(vertices)
        before = (vertices + 0.3 * np.max(high - low) * rng.normal(size=vertices.shape)).astype(np.float32)
    elif rng.random() < 0.15 and len(faces):
        vertices = vertices.copy()
        broken = rng.integers(0, len(vertices), 1 + len(vertices) // 20)
        vertices[broken, rng.integers(0, 3, len(broken))] = rng.choice([np.nan, np.inf, -np.inf], len(broken))
    geometry = Geometry(vertices, faces, np.zeros((0, 4), np.float32))
    return Case(geometry, rays_of(rng, vertices[faces]), None, before)


def with_spheres(rng: Rng) -> Case:
    vertices, faces = mesh_of(rng)
    return Case(Geometry(vertices, faces, balls(rng, vertices)), rays_of(rng, vertices[faces]))


def placement(rng: Rng, size: float) -> np.ndarray:
    matrix = np.eye(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if rng.random() < 0.7 else np.eye(3)
    matrix[:3, :3] = turn * np.exp(rng.normal(0.0, 0.5, 3))
    matrix[:3, 3] = size * rng.normal(size=3)
    return matrix


def placed(rng: Rng, spheres: bool) -> Scene:
    """Return a scene with one to three meshes, each with one to four instances."""
    grey, objects = (Material(),), []
    for _ in range(rng.integers(1, 4)):
        vertices, faces = mesh_of(rng)
        mesh = Mesh(vertices, faces)
        size = float(np.max(np.subtract(*extent(vertices)[::-1])))
        objects += [Object(mesh, grey, placement(rng, size)) for _ in range(rng.integers(1, 5))]
    balls = [Sphere(rng.normal(size=3), rng.uniform(0.1, 1.0), grey[0]) for _ in range(rng.integers(0, 3))] if spheres else []
    return Scene(tuple(objects), tuple(balls))


def corners_of(scene: Scene) -> np.ndarray:
    return np.concatenate([(thing.mesh.vertices @ thing.transform[:3, :3].T + thing.transform[:3, 3])[thing.mesh.faces]
                           for thing in scene.objects])


def instances(rng: Rng) -> Case:
    scene = placed(rng, spheres=True)
    return Case(flatten(scene, instanced_meshes(scene, "always")).geometry, rays_of(rng, corners_of(scene)))


def worlds(rng: Rng) -> Case:
    scenes = [placed(rng, spheres=False) for _ in range(rng.integers(1, 4))]
    rays = rays_of(rng, np.concatenate([corners_of(scene) for scene in scenes]))
    return Case(scenes, rays, rng.integers(0, len(scenes), RAYS).astype(np.int32))


KINDS: dict[str, Callable[[Rng], Case]] = {
    "plain": plain, "with spheres": with_spheres, "instances": instances, "worlds": worlds}

# --- ways to pass rays ------------------------------------------------------------------------------------------------


def in_packets(rays: Rays) -> Iterator[np.ndarray]:
    """Yield calls of up to PACKETS packets: the rays of a packet have directions in the same octant."""
    octants = np.signbit(rays.directions) @ (1, 2, 4)
    blocks = [np.resize(of, -(-len(of) // PACKET) * PACKET).reshape(-1, PACKET)
              for of in (np.flatnonzero(octants == octant) for octant in range(8)) if len(of)]
    together = np.concatenate(blocks)
    for first in range(0, len(together), PACKETS):
        yield together[first : first + PACKETS].ravel()


def alike(rays: Rays) -> Iterator[np.ndarray]:
    """Yield calls of packets that repeat one ray: their bounds have no slack that could hide rounding errors. Two rays of each
    packet are the empty rays."""
    together = np.repeat(np.arange(len(rays)), PACKET)
    together[::PACKET], together[5::PACKET] = EMPTY, EMPTY - 1
    yield from np.split(together, range(PACKET * PACKETS, len(together), PACKET * PACKETS))


def without_packets(rays: Rays) -> Iterator[np.ndarray]:
    """Yield one call with two opposite rays among every PACKET rays, so that no packets form."""
    index = np.resize(np.arange(len(rays)), -(-len(rays) // (PACKET - 2)) * (PACKET - 2)).reshape(-1, PACKET - 2)
    against = np.tile([AGAINST, AGAINST - 1], (len(index), 1))
    yield np.concatenate([index, against], axis=1).ravel()


def many(rays: Rays) -> Iterator[np.ndarray]:
    yield np.resize(np.arange(len(rays)), np.random.default_rng(len(rays)).integers(*MANY))


def as_they_are(rays: Rays) -> Iterator[np.ndarray]:
    yield np.arange(len(rays))


# Indices of further rays, which are not rays of the case.
AGAINST = -1  # And -2: two rays of opposite directions; from Warp arrays, their directions are NaN.
EMPTY = -3  # And -4: the same rays with t_max < t_min.


def filled(rays: Rays, index: np.ndarray, nan: bool) -> Rays:
    """Return the rays of `index`, negative indices for the further rays. nan: make the directions of the further rays NaN."""
    out = Rays(*(array[np.maximum(index, 0)] for array in (rays.origins, rays.directions, rays.t_min, rays.t_max)))
    for extra, sign, end in ((AGAINST, 1.0, np.inf), (AGAINST - 1, -1.0, np.inf), (EMPTY, 1.0, -1.0), (EMPTY - 1, -1.0, -1.0)):
        rows = index == extra
        out.origins[rows], out.directions[rows], out.t_min[rows], out.t_max[rows] = 0.0, sign, 0.0, end
        if nan:
            out.directions[rows] = np.nan
    return out


@dataclass(frozen=True)
class Way:
    """A way to pass rays to a structure."""

    order: Callable[[Rays], Iterator[np.ndarray]] = as_they_are  # Yields the ray indices of each call.
    source: str = "numpy"  # Or "float64" (with gaps between rows), or "warp".
    counters: bool = False  # Count nodes and primitives, which traces one ray at a time.


WAYS = {
    "as they are": Way(), "packets": Way(in_packets), "alike": Way(alike), "no packets": Way(without_packets), "many": Way(many),
    "float64": Way(source="float64"), "warp": Way(without_packets, "warp"), "many of warp": Way(many, "warp"),
    "counting": Way(counters=True),
}


def query(accel: Any, rays: Rays, way: Way, world: np.ndarray | None) -> tuple[Any, np.ndarray]:
    """Return closest_hit and any_hit as NumPy arrays. t_min and t_max are passed as numbers if they are the same for all rays."""
    arrays = [rays.origins, rays.directions, rays.t_min, rays.t_max]
    if way.source == "float64":
        arrays = [np.repeat(array.astype(np.float64), 2, axis=0)[::2] for array in arrays]
    if way.source == "warp":
        arrays = [wp.array(array, dtype=dtype, device=accel.device)
                  for array, dtype in zip(arrays, (wp.vec3, wp.vec3, wp.float32, wp.float32), strict=True)]
    elif len(rays):
        arrays[2:] = [float(end[0]) if (end == end[0]).all() else end for end in arrays[2:]]
    more = {} if world is None else {"world": world}
    hits = accel.closest_hit(*arrays, **more, **({"counters": True} if way.counters else {})).numpy()
    occluded = accel.any_hit(*arrays, **more)
    return hits, occluded.numpy() if isinstance(occluded, wp.array) else occluded


ALL_WAYS = ("bvh8",)  # structures with a kernel for many rays at a time: every case tries all ways
SOME = 0.4  # probability of another structure to be in a case, and of each of its ways
FIELDS = "t", "u", "v", "prim_id"


def differences(accel: Any, rays: Rays, world: np.ndarray | None, expected: Any, way: Way) -> Iterator[str]:
    """Yield a description of each difference between the answers by a way and the expected hits."""
    for index in way.order(rays):
        of_each = None if world is None else world[np.maximum(index, 0)]
        hits, occluded = query(accel, filled(rays, index, way.source == "warp"), way, of_each)
        if ((hits.prim_id >= 0) | occluded)[(index <= EMPTY) | ((index < 0) & (way.source == "warp"))].any():
            yield "a ray that is not finite, or whose t_max < t_min, hits something"
        real, rows = index >= 0, index[index >= 0]
        for name in FIELDS:
            got, wanted = getattr(hits, name)[real], getattr(expected, name)[rows]
            if bad := np.flatnonzero(got.view(np.int32) != wanted.view(np.int32)).tolist():
                yield f"{name} of ray {rows[bad[0]]} ({len(bad)} rays differ): {got[bad[0]]}, expected {wanted[bad[0]]}"
        if bad := np.flatnonzero(occluded[real] != (expected.prim_id[rows] >= 0)).tolist():
            yield f"any_hit of ray {rows[bad[0]]} ({len(bad)} rays differ)"


def all_hits(accel: Any, rays: Rays, crossings: bool) -> list[np.ndarray]:
    """Return the arrays of wrt.all_hits, of the first three hits, and of wrt.count_hits."""
    arguments = rays.origins, rays.directions, rays.t_min, rays.t_max
    every = wrt.all_hits(accel, *arguments, crossings=crossings)
    first = wrt.first_hits(accel, 3, *arguments, crossings=crossings)
    out = [every.first, every.t, every.u, every.v, every.prim_id, *(getattr(first, name) for name in FIELDS)]
    return [*out, wrt.count_hits(accel, *arguments, crossings=crossings)]


@cache
def own_kernel(name: str) -> Any:
    """Make a kernel as a user would write it: the closest hit, the next hit, and any_hit."""
    query = wrt.ray_query(name)

    @wrt.kernel
    def trace(world: query.World, rays: RayArrays, hits: HitArrays, later: HitArrays, occluded: wp.array(dtype=wp.bool)):
        i = wp.tid()
        ray = query.ray(rays.origin[i], rays.direction[i])
        ray.t_min = rays.t_min[i]
        ray.t_max = rays.t_max[i]
        hit = query.closest_hit(world, ray)
        store_hit(hits, i, hit, 1.0)
        occluded[i] = query.any_hit(world, ray)
        if hit.prim_id >= 0:
            hit = query.next_hit(world, ray, hit)
        store_hit(later, i, hit, 1.0)

    return trace


def by_own_kernel(accel: Any, name: str, rays: Rays) -> list[np.ndarray]:
    """Return the first two hits of each ray, an array (N, 2) for each of FIELDS, and any_hit, (N,) bool."""
    given, hits, later = RayArrays(), HitArrays(), HitArrays()
    for field, array in zip(fields_of(RayArrays), (rays.origins, rays.directions, rays.t_min, rays.t_max), strict=True):
        setattr(given, field, wp.array(array, dtype=wp.vec3 if array.ndim == 2 else wp.float32, device=accel.device))
    for out in (hits, later):
        for field, dtype in zip(FIELDS, (wp.float32, wp.float32, wp.float32, wp.int32), strict=True):
            setattr(out, field, wp.empty(len(rays), dtype=dtype, device=accel.device))
    occluded = wp.empty(len(rays), dtype=wp.bool, device=accel.device)
    wp.launch(own_kernel(name), dim=len(rays), inputs=[accel.world, given, hits, later, occluded], device=accel.device)
    return [*(np.stack([getattr(out, name).numpy() for out in (hits, later)], axis=1) for name in FIELDS), occluded.numpy()]


def same_bits(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True))


# --- one case ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scope:
    """The structures to check; of these, the structures to check with counters, with lists of all hits, and with a user's kernel.
    Each combination compiles kernels."""

    structures: Collection[str] = tuple(STRUCTURES)
    counting: Collection[str] = tuple(STRUCTURES)
    listing: Collection[str] = tuple(STRUCTURES)
    own: Collection[str] = tuple(STRUCTURES)


def options_of(rng: Rng, name: str) -> dict[str, Any]:
    """Return random options `builder` and `max_leaf`, if structures of that name have them."""
    has, options = {each.name for each in fields(wrt.ACCELERATORS[name].options)}, dict[str, Any]()
    if "builder" in has and rng.random() < 0.7:
        options["builder"] = str(rng.choice([*BVH_BUILDERS]))
    if "max_leaf" in has and rng.random() < 0.5:
        options["max_leaf"] = int(rng.integers(1, 20))
    return options


def built(rng: Rng, name: str, case: Case) -> Any:
    """Build a structure over the case's geometry, by a refit if the case has vertices before it."""
    options = options_of(rng, name)
    if case.before is not None and wrt.ACCELERATORS[name].can_refit:
        accel = wrt.build(replace(case.given, vertices=case.before), name, threads=1, **options)
        accel.refit(case.given.vertices)
        return accel
    return wrt.build(case.given, name, threads=1, **options)


def problems(number: int, seed: int, scope: Scope) -> Iterator[str]:
    """Yield a description of each difference of a case from brute force."""
    rng = np.random.default_rng((number, seed))
    kind = [*KINDS][number % len(KINDS)]
    case = KINDS[kind](rng)
    with_world = {} if case.world is None else {"world": case.world}
    brute = wrt.build(case.given, "brute_force", threads=1)

    def truth(rays: Rays) -> Any:
        return brute.closest_hit(rays.origins, rays.directions, rays.t_min, rays.t_max, **with_world)

    segments = at_their_hits(rng, case.rays, truth(case.rays))
    sets = [(rays, truth(rays)) for rays in (case.rays, segments)]
    crossings = bool(rng.random() < 0.3 and np.isfinite(getattr(case.given, "vertices", np.nan)).all())
    lists = [all_hits(brute, rays, crossings) for rays, _ in sets] if kind == "plain" and scope.listing else []
    for name in scope.structures:
        if name not in ALL_WAYS and rng.random() >= SOME:
            continue
        with np.errstate(invalid="ignore"):  # faces may not be finite
            accel = built(rng, name, case)
        for which, (rays, expected) in enumerate(sets):
            for way, how in WAYS.items():
                if (name in scope.counting if how.counters else name in ALL_WAYS or rng.random() < SOME):
                    for what in differences(accel, rays, case.world, expected, how):
                        yield f"{name}, {kind}, rays {which}, {way}: {what}"
            if kind == "plain" and name in scope.listing and not same_bits(all_hits(accel, rays, crossings), lists[which]):
                yield f"{name}, rays {which}: all hits, crossings {crossings}"
            if kind == "plain" and name in scope.own:
                two = wrt.first_hits(accel, 2, rays.origins, rays.directions, rays.t_min, rays.t_max)
                wanted = [*(getattr(two, field) for field in FIELDS), expected.prim_id >= 0]
                if not same_bits(by_own_kernel(accel, name, rays), wanted):
                    yield f"{name}, rays {which}: a user's kernel"


def check(number: int, seed: int, scope: Scope = Scope()) -> str:
    """Return a description of the first difference and the number of the others; "" without any."""
    found = [*problems(number, seed, scope)]
    return f"{found[0]} and {len(found) - 1} more" if found else ""


if __name__ == "__main__":
    random_cases.main(__doc__, check, 100)
