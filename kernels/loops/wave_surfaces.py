"""The surfaces at a wave's hits. Triangles and spheres are loaded one by one; their surfaces are computed in vectorised loops."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import HITS, SPHERES, SURFACES, SphereHit, TriangleHit
from wrt.kernels.memory import prefetch
from wrt.kernels.query import load_hit, load_render_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.surface import Place, Surface, facing, make_on_sphere, make_on_triangle, make_triangle_at
from wrt.kernels.structs import Surfaces

store_sphere = SPHERES.store()
FAR = 16  # Number of hits between the prefetch of a triangle's corners and their load.


@wp.func
def hit_triangle(wave: Wave, surfaces: Surfaces, j: int) -> int:
    """Return the prim_id of hit j's triangle. For a hit on a sphere, return any valid prim_id; nothing reads the result."""
    return wp.min(wave.queue.hits.prim_id[wave.outcomes.hit_rays[j]], surfaces.n_triangles - 1)


class Attributes:
    """Which attributes a scene's surfaces have, and which fields of the rows HITS and SURFACES are therefore not stored."""

    def __init__(self, features: Features) -> None:
        self.smooth, self.tangents, self.spheres = features.smooth, features.normal_maps, features.spheres
        self.uvs = features.textures or features.checkerboards
        normals, uvs = () if self.smooth else ("n0", "n1", "n2"), () if self.uvs else ("u", "v")
        self.not_of_hits = (*(f"triangle.{name}" for name in normals + uvs), *(() if self.uvs else ("material",)),
                            *(() if self.tangents else ("is_mapped", "normal_scale")))
        self.not_of_surfaces = ("material", "exclude_plus_one", "smooth", *uvs, *(() if self.tangents else ("tangent", "bitangent_sign")))


def make_load_hits(has: Attributes) -> Any:
    """Return load_hits(wave, surfaces, first, end, hits) -> int: store hits first .. end - 1 in the rows HITS.

    hits: number of all hits. The result is the number of hits on spheres among these."""
    smooth, uvs, tangents = has.smooth, has.uvs, has.tangents
    triangle_at, store_hit = make_triangle_at(smooth, uvs, False), HITS.store(*has.not_of_hits)

    @wp.func
    def prefetch_triangles(wave: Wave, surfaces: Surfaces, j: int, hits: int):
        """Prefetch the corners of hit j + FAR, and the face of hit j + 2 FAR."""
        prim_id = hit_triangle(wave, surfaces, wp.min(j + 2 * FAR, hits - 1))
        prefetch(surfaces.faces, prim_id)
        prefetch(surfaces.prim_material, prim_id)
        face = surfaces.faces[hit_triangle(wave, surfaces, wp.min(j + FAR, hits - 1))]
        for corner in range(3):
            prefetch(surfaces.vertices, face[corner])
            if wp.static(smooth):
                prefetch(surfaces.normals, face[corner])
            if wp.static(uvs):
                prefetch(surfaces.uvs, face[corner])

    @wp.func
    def load_hits(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int) -> int:
        on_spheres = int(0)
        for j in range(first, end):
            k = wave.outcomes.hit_rays[j]
            prim_id = wave.queue.hits.prim_id[k]
            hit = TriangleHit()
            if surfaces.n_triangles > 0:
                prefetch_triangles(wave, surfaces, j, hits)
                place = Place()
                place.face = hit_triangle(wave, surfaces, j)
                hit.triangle = triangle_at(surfaces, place)
            hit.material = surfaces.prim_material[prim_id]
            if wp.static(tangents):
                hit.is_mapped = wp.where(surfaces.materials[hit.material].normal_texture >= 0, 1, 0)
                hit.normal_scale = surfaces.materials[hit.material].normal_scale
            hit.u = wave.queue.hits.u[k]
            hit.v = wave.queue.hits.v[k]
            hit.direction = wave.queue.rays.direction[k]
            store_hit(wave.block.rows, j - first, hit)
            on_spheres += wp.where(prim_id >= surfaces.n_triangles, 1, 0)
        return on_spheres

    return load_hits


@wp.func
def load_spheres(wave: Wave, surfaces: Surfaces, first: int, end: int):
    """Store the hits first .. end - 1 in the rows SPHERES. It is branch-free: hits on spheres and triangles alternate unpredictably."""
    for j in range(first, end):
        k = wave.outcomes.hit_rays[j]
        hit = SphereHit()
        index = wave.queue.hits.prim_id[k] - surfaces.n_triangles
        hit.is_hit = wp.where(index >= 0, 1, 0)
        hit.sphere = surfaces.spheres[wp.max(index, 0)]
        hit.point = wave.queue.rays.origin[k] + wave.queue.hits.t[k] * wave.queue.rays.direction[k]
        store_sphere(wave.block.rows, j - first, hit)


def make_choose(has: Attributes) -> Any:
    """Return choose(condition, a, b) -> Surface: a if `condition`, else b, field by field, so that loops vectorise."""

    @wp.func
    def choose(condition: bool, a: Surface, b: Surface) -> Surface:
        s = Surface()
        s.point = where_vec3(condition, a.point, b.point)
        s.error = where_vec3(condition, a.error, b.error)
        s.geometric = where_vec3(condition, a.geometric, b.geometric)
        s.shading = where_vec3(condition, a.shading, b.shading)
        s.front = wp.where(condition, a.front, b.front)
        if wp.static(has.uvs):
            s.u = wp.where(condition, a.u, b.u)
            s.v = wp.where(condition, a.v, b.v)
        if wp.static(has.tangents):
            s.tangent = where_vec3(condition, a.tangent, b.tangent)
            s.bitangent_sign = wp.where(condition, a.bitangent_sign, b.bitangent_sign)
        return s

    return choose


def make_replace_spheres(has: Attributes) -> Any:
    """Return replace_spheres(rows, count): put the surfaces of the spheres in SPHERES in the rows SURFACES, where the ray hit one."""
    on_sphere, choose = make_on_sphere(has.uvs, has.tangents), make_choose(has)
    load_direction, load_sphere = HITS.field("direction").load(), SPHERES.load()
    load_surface, store_surface = SURFACES.load(*has.not_of_surfaces), SURFACES.store(*has.not_of_surfaces)

    @wp.func
    def replace_spheres(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            hit = load_sphere(rows, i)
            surface = facing(on_sphere(hit.sphere, hit.point), load_direction(rows, i))
            store_surface(rows, i, choose(hit.is_hit != 0, surface, load_surface(rows, i)))
            i = i + 1

    return replace_spheres


def make_compute_surfaces(has: Attributes) -> Any:
    """Return compute_surfaces(wave, surfaces, first, end, hits): fill the rows SURFACES for the hits first .. end - 1.

    hits: number of all hits, in outcomes.hit_rays. `end - first` is at most BLOCK."""
    load_hits, replace_spheres = make_load_hits(has), make_replace_spheres(has)
    on_triangle = make_on_triangle(has.smooth, has.uvs, has.tangents)
    load_hit, store_surface = HITS.load(*has.not_of_hits), SURFACES.store(*has.not_of_surfaces)

    @wp.func
    def compute_surfaces(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        on_spheres = load_hits(wave, surfaces, first, end, hits)
        rows = wave.block.rows
        i = int(0)
        while i < end - first:
            hit = load_hit(rows, i)
            store_surface(rows, i, facing(on_triangle(hit.triangle, hit.u, hit.v), hit.direction))
            i = i + 1
        if wp.static(has.spheres):
            if on_spheres > 0:
                load_spheres(wave, surfaces, first, end)
                replace_spheres(rows, end - first)

    return compute_surfaces


def make_hit_surface(has: Attributes) -> Any:
    """Return hit_surface(wave, surfaces, i, k) -> Surface of hit i of the block, at place k of the queue, from the rows SURFACES."""
    load_surface = SURFACES.load(*has.not_of_surfaces)

    @wp.func
    def hit_surface(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        prim_id = wave.queue.hits.prim_id[k]
        s = load_surface(wave.block.rows, i)
        s.material = surfaces.prim_material[prim_id]
        s.exclude_plus_one = prim_id + 1
        if wp.static(has.spheres):
            s.exclude_plus_one = wp.where(prim_id < surfaces.n_triangles, prim_id + 1, 0)
        return s

    return hit_surface


def make_wave_surfaces(features: Features, surface_at: Any) -> tuple[Any, Any]:
    """Return compute_surfaces and hit_surface. With instances, compute_surfaces is None, and hit_surface calls `surface_at`."""

    @wp.func
    def single_hit_surface(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        return surface_at(surfaces, load_render_ray(wave.queue.rays, k), load_hit(wave.queue.hits, k))

    if features.instances:
        return None, single_hit_surface
    has = Attributes(features)
    return make_compute_surfaces(has), make_hit_surface(has)
