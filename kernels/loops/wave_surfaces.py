"""The surfaces at a wave's hits. Triangles are loaded one by one; their surfaces are computed in vectorised loops."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import Wave
from wrt.kernels.loops.wave_rows import HITS, SURFACES, TriangleHit
from wrt.kernels.memory import prefetch
from wrt.kernels.query import load_hit, load_render_ray
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.surface import Surface, facing, make_on_sphere, make_on_triangle, make_place_of, make_triangle_at
from wrt.kernels.structs import Surfaces

FAR = 16  # Number of hits between the prefetch of a triangle's corners and their load.


@wp.func
def hit_triangle(wave: Wave, surfaces: Surfaces, j: int) -> int:
    """Return the prim_id of hit j's triangle. For a hit on a sphere, return any valid prim_id; nothing reads the result."""
    return wp.min(wave.queue.hits.prim_id[wave.outcomes.hit_rays[j]], surfaces.n_triangles - 1)


class Attributes:
    """Which attributes a scene's surfaces have, and which fields of the rows HITS and SURFACES are therefore not stored."""

    def __init__(self, features: Features) -> None:
        self.smooth, self.tangents = features.smooth, features.normal_maps
        self.uvs = features.textures or features.checkerboards
        normals, uvs = () if self.smooth else ("n0", "n1", "n2"), () if self.uvs else ("u", "v")
        self.not_of_hits = (*(f"triangle.{name}" for name in normals + uvs), *(() if self.uvs else ("material",)),
                            *(() if self.tangents else ("is_mapped", "normal_scale")))
        self.not_of_surfaces = ("material", "exclude_plus_one", "smooth", *uvs, *(() if self.tangents else ("tangent", "bitangent_sign")))


def make_load_triangles(has: Attributes) -> Any:
    """Return load_triangles(wave, surfaces, first, end, hits): store hits first .. end - 1 in the rows HITS. hits: number of hits."""
    smooth, uvs, tangents = has.smooth, has.uvs, has.tangents
    place_of, triangle_at = make_place_of(False), make_triangle_at(smooth, uvs, False)
    store_hit = HITS.store(*has.not_of_hits)

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
    def load_triangles(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        for j in range(first, end):
            prefetch_triangles(wave, surfaces, j, hits)
            k = wave.outcomes.hit_rays[j]
            place = place_of(surfaces, hit_triangle(wave, surfaces, j))
            hit = TriangleHit()
            hit.triangle = triangle_at(surfaces, place)
            hit.material = wp.where(wave.queue.hits.prim_id[k] < surfaces.n_triangles, place.material, -1)
            if wp.static(tangents):
                hit.is_mapped = wp.where(surfaces.materials[place.material].normal_texture >= 0, 1, 0)
                hit.normal_scale = surfaces.materials[place.material].normal_scale
            hit.u = wave.queue.hits.u[k]
            hit.v = wave.queue.hits.v[k]
            hit.direction = wave.queue.rays.direction[k]
            store_hit(wave.block.rows, j - first, hit)

    return load_triangles


def make_compute_surfaces(has: Attributes) -> Any:
    """Return compute_surfaces(wave, surfaces, first, end, hits): fill the rows SURFACES for the hits first .. end - 1.

    hits: number of all hits, in outcomes.hit_rays. `end - first` is at most BLOCK."""
    load_triangles = make_load_triangles(has)
    on_triangle = make_on_triangle(has.smooth, has.uvs, has.tangents)
    load_hit, store_surface = HITS.load(*has.not_of_hits), SURFACES.store(*has.not_of_surfaces)

    @wp.func
    def compute_surfaces(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        if surfaces.n_triangles == 0:
            return
        load_triangles(wave, surfaces, first, end, hits)
        rows = wave.block.rows
        i = int(0)
        while i < end - first:
            hit = load_hit(rows, i)
            store_surface(rows, i, facing(on_triangle(hit.triangle, hit.u, hit.v), hit.direction))
            i = i + 1

    return compute_surfaces


def make_hit_surface(has: Attributes, spheres: bool) -> Any:
    """Return hit_surface(wave, surfaces, i, k) -> Surface of hit i of the block, at place k of the queue.

    Surfaces of triangles are loaded from the rows SURFACES; surfaces of spheres are computed."""
    on_sphere = make_on_sphere(has.uvs, has.tangents)
    load_surface = SURFACES.load(*has.not_of_surfaces)

    @wp.func
    def hit_surface(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        hit = load_hit(wave.queue.hits, k)
        if wp.static(spheres):
            if hit.prim_id >= surfaces.n_triangles:
                sphere = facing(on_sphere(surfaces, load_render_ray(wave.queue.rays, k), hit), wave.queue.rays.direction[k])
                sphere.material = surfaces.prim_material[hit.prim_id]
                return sphere
        s = load_surface(wave.block.rows, i)
        s.material = surfaces.prim_material[hit.prim_id]
        s.exclude_plus_one = hit.prim_id + 1
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
    return make_compute_surfaces(has), make_hit_surface(has, features.spheres)
