"""The surfaces at a wave's hits, many at a time: triangles are gathered, and computed in lanes (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import BLOCK, Wave
from wrt.kernels.memory import call_in_int, call_in_vec2, call_in_vec3, call_in_vec3i, number_at, put_number
from wrt.kernels.query import hit_at, queued_ray
from wrt.kernels.shade.surface import (
    Surface,
    Triangle,
    facing,
    make_on_sphere,
    make_on_triangle,
    make_place_of,
    make_triangle_at,
)
from wrt.kernels.structs import Surfaces

# Rows of a block, with a number for each hit, and how many each thing has: what is gathered, and what is computed of it (bent: the
# shading normal as lights see it).
GATHERED = {"v0": 3, "v1": 3, "v2": 3, "n0": 3, "n1": 3, "n2": 3, "u": 1, "v": 1, "direction": 3, "tu": 3, "tv": 3}
COMPUTED = {"point": 3, "error": 3, "geometric": 3, "shading": 3, "front": 1, "tex_u": 1, "tex_v": 1, "tangent": 3,
            "bitangent_sign": 1, "bent": 3}
# Then (wave_textures.py, wave_numbers.py, wave_lights.py) what textures say, what chooses a microfacet, and what the first light
# and the sky send; and, in place of what was gathered, an emitter.
SAMPLED = {"albedo": 4, "emissive": 3, "parameters": 3, "transmission": 1, "mapped": 3, "normal_scale": 1, "facet": 3,
           "wi": 3, "weight": 3, "end": 3, "sky_wi": 3, "sky_weight": 3}
EMITTER = {"e0": 3, "e1": 3, "e2": 3, "normal": 3, "emission": 3, "pdf_area": 1, "two_sided": 1, "within": 1, "across": 1}
ROWS = sum(GATHERED.values()) + sum(COMPUTED.values()) + sum(SAMPLED.values())


def first_rows(sizes: dict[str, int]) -> dict[str, int]:
    """Where each thing begins."""
    return {name: sum(list(sizes.values())[:i]) for i, name in enumerate(sizes)}


ROW = first_rows({**GATHERED, **COMPUTED, **SAMPLED}) | first_rows(EMITTER)
FAR = 16  # hits whose triangle is called in before it is gathered


@wp.func
def row_number(rows: wp.array(dtype=wp.float32), row: int, i: int) -> float:
    """Of hit i of a block."""
    return number_at(rows, row * BLOCK + i)


@wp.func
def put_row_number(rows: wp.array(dtype=wp.float32), row: int, i: int, value: float):
    put_number(rows, row * BLOCK + i, value)


@wp.func
def row_vec3(rows: wp.array(dtype=wp.float32), row: int, i: int) -> wp.vec3:
    return wp.vec3(row_number(rows, row, i), row_number(rows, row + 1, i), row_number(rows, row + 2, i))


@wp.func
def put_row_vec3(rows: wp.array(dtype=wp.float32), row: int, i: int, value: wp.vec3):
    put_row_number(rows, row, i, value[0])
    put_row_number(rows, row + 1, i, value[1])
    put_row_number(rows, row + 2, i, value[2])


def make_wave_surfaces(features: Any, surface_at: Any) -> tuple[Any, Any]:
    """find(wave, surfaces, first, end, hits): computes those of the hits first .. end - 1, at most BLOCK, of so many; found(wave,
    surfaces, i, k) -> Surface: of the i-th of them, at place k in the queue.

    Spheres, and with instances all, are computed one by one, when they are asked for; surface_at: of make_shading.
    """
    smooth, uvs, tangents = features.smooth, features.textures or features.checkerboards, features.normal_maps
    place_of, triangle_at = make_place_of(False), make_triangle_at(smooth, uvs, False)
    on_triangle, on_sphere = make_on_triangle(smooth, uvs, tangents), make_on_sphere(uvs, tangents)

    @wp.func
    def hit_triangle(wave: Wave, surfaces: Surfaces, j: int) -> int:
        """Of hit j; of a sphere any, whose numbers are computed in vain."""
        return wp.min(wave.hits.prim_id[wave.met[j]], surfaces.n_triangles - 1)

    @wp.func
    def call_in(wave: Wave, surfaces: Surfaces, j: int, hits: int):
        """The face of a hit after j, and the corners of one before that."""
        prim_id = hit_triangle(wave, surfaces, wp.min(j + 2 * FAR, hits - 1))
        call_in_vec3i(surfaces.faces, prim_id)
        call_in_int(surfaces.prim_material, prim_id)
        face = surfaces.faces[hit_triangle(wave, surfaces, wp.min(j + FAR, hits - 1))]
        for corner in range(3):
            call_in_vec3(surfaces.vertices, face[corner])
            if wp.static(smooth):
                call_in_vec3(surfaces.normals, face[corner])
            if wp.static(uvs):
                call_in_vec2(surfaces.uvs, face[corner])

    @wp.func
    def gather(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        for j in range(first, end):
            call_in(wave, surfaces, j, hits)
            k = wave.met[j]
            i = j - first
            t = triangle_at(surfaces, place_of(surfaces, hit_triangle(wave, surfaces, j)))
            put_row_vec3(wave.rows, wp.static(ROW["v0"]), i, t.v0)
            put_row_vec3(wave.rows, wp.static(ROW["v1"]), i, t.v1)
            put_row_vec3(wave.rows, wp.static(ROW["v2"]), i, t.v2)
            if wp.static(smooth):
                put_row_vec3(wave.rows, wp.static(ROW["n0"]), i, t.n0)
                put_row_vec3(wave.rows, wp.static(ROW["n1"]), i, t.n1)
                put_row_vec3(wave.rows, wp.static(ROW["n2"]), i, t.n2)
            if wp.static(uvs):
                put_row_vec3(wave.rows, wp.static(ROW["tu"]), i, t.u)
                put_row_vec3(wave.rows, wp.static(ROW["tv"]), i, t.v)
            put_row_number(wave.rows, wp.static(ROW["u"]), i, wave.hits.u[k])
            put_row_number(wave.rows, wp.static(ROW["v"]), i, wave.hits.v[k])
            put_row_vec3(wave.rows, wp.static(ROW["direction"]), i, wave.rays.direction[k])

    @wp.func
    def gathered(rows: wp.array(dtype=wp.float32), i: int) -> Triangle:
        t = Triangle()
        t.v0 = row_vec3(rows, wp.static(ROW["v0"]), i)
        t.v1 = row_vec3(rows, wp.static(ROW["v1"]), i)
        t.v2 = row_vec3(rows, wp.static(ROW["v2"]), i)
        if wp.static(smooth):
            t.n0 = row_vec3(rows, wp.static(ROW["n0"]), i)
            t.n1 = row_vec3(rows, wp.static(ROW["n1"]), i)
            t.n2 = row_vec3(rows, wp.static(ROW["n2"]), i)
        if wp.static(uvs):
            t.u = row_vec3(rows, wp.static(ROW["tu"]), i)
            t.v = row_vec3(rows, wp.static(ROW["tv"]), i)
        return t

    @wp.func
    def find(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        if surfaces.n_triangles == 0:
            return
        gather(wave, surfaces, first, end, hits)
        rows = wave.rows
        i = int(0)
        while i < end - first:
            u = row_number(rows, wp.static(ROW["u"]), i)
            v = row_number(rows, wp.static(ROW["v"]), i)
            direction = row_vec3(rows, wp.static(ROW["direction"]), i)
            s = facing(on_triangle(gathered(rows, i), u, v), direction)
            put_row_vec3(rows, wp.static(ROW["point"]), i, s.point)
            put_row_vec3(rows, wp.static(ROW["error"]), i, s.error)
            put_row_vec3(rows, wp.static(ROW["geometric"]), i, s.geometric)
            put_row_vec3(rows, wp.static(ROW["shading"]), i, s.shading)
            put_row_number(rows, wp.static(ROW["front"]), i, float(s.front))
            if wp.static(uvs):
                put_row_number(rows, wp.static(ROW["tex_u"]), i, s.u)
                put_row_number(rows, wp.static(ROW["tex_v"]), i, s.v)
            if wp.static(tangents):
                put_row_vec3(rows, wp.static(ROW["tangent"]), i, s.tangent)
                put_row_number(rows, wp.static(ROW["bitangent_sign"]), i, s.bitangent_sign)
            i = i + 1

    @wp.func
    def found(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        hit = hit_at(wave.hits, k)
        if wp.static(features.spheres):
            if hit.prim_id >= surfaces.n_triangles:
                sphere = facing(on_sphere(surfaces, queued_ray(wave.rays, k), hit), wave.rays.direction[k])
                sphere.material = surfaces.prim_material[hit.prim_id]
                return sphere
        rows = wave.rows
        s = Surface()
        s.point = row_vec3(rows, wp.static(ROW["point"]), i)
        s.error = row_vec3(rows, wp.static(ROW["error"]), i)
        s.geometric = row_vec3(rows, wp.static(ROW["geometric"]), i)
        s.shading = row_vec3(rows, wp.static(ROW["shading"]), i)
        s.front = int(row_number(rows, wp.static(ROW["front"]), i))
        if wp.static(uvs):
            s.u = row_number(rows, wp.static(ROW["tex_u"]), i)
            s.v = row_number(rows, wp.static(ROW["tex_v"]), i)
        if wp.static(tangents):
            s.tangent = row_vec3(rows, wp.static(ROW["tangent"]), i)
            s.bitangent_sign = row_number(rows, wp.static(ROW["bitangent_sign"]), i)
        s.material = surfaces.prim_material[hit.prim_id]
        s.exclude_plus_one = hit.prim_id + 1
        return s

    @wp.func
    def find_nothing(wave: Wave, surfaces: Surfaces, first: int, end: int, hits: int):
        pass

    @wp.func
    def found_alone(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        return surface_at(surfaces, queued_ray(wave.rays, k), hit_at(wave.hits, k))

    return (find_nothing, found_alone) if features.instances else (find, found)
