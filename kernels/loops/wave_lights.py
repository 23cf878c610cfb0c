"""Samples of lights for a wave's hits, many at a time: what needs no branches is computed in lanes (kernels.memory)."""

from typing import Any

import warp as wp

from wrt.kernels.loops.wave import Wave
from wrt.kernels.loops.wave_normals import row_of_normals
from wrt.kernels.loops.wave_surfaces import ROW, put_row_number, put_row_vec3, row_number, row_vec3
from wrt.kernels.memory import bits_at, put_number
from wrt.kernels.shade.backgrounds import BACKGROUNDS, make_sky_point, make_sky_sample
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.lights import LIGHTS, LightSample, choose_emitter, from_emitter
from wrt.kernels.shade.sampling import triangle_numbers
from wrt.kernels.shade.surface import Surface, Triangle, triangle_point, triangle_point_error
from wrt.kernels.structs import Lighting, Surfaces

MESH = list(LIGHTS).index("mesh")


@wp.func
def first_is_mesh(lighting: Lighting) -> bool:
    if lighting.count == 0:
        return False
    return lighting.lights[0].kind == MESH


def make_wave_lights(features: Any, shading: Any, found: Any, choose: Any) -> tuple[Any, Any, bool]:
    """sample_lights(wave, surfaces, lighting, first, end): for the hits first .. end - 1, at most BLOCK, whose surfaces are found;
    light_at(wave, surfaces, lighting, surface, key, index, light, i) -> LightSample for the i-th of them: what was computed before,
    or by `choose` (of make_step). found: of make_wave_surfaces.

    Computed before: the first light where it is a mesh, and a sky that is sampled by the cosine, or its points alone where normals
    are computed one by one (wave_normals.py). The third: whether keys must be put before (wave_numbers.py).
    """
    light_numbers, light_point = make_light_points(features)
    sky_point, sky_sample = make_sky_point(features), make_sky_sample(features)
    kind = BACKGROUNDS[features.background]
    points = features.sky_light and kind.sample is None and kind.seen is None
    normals = row_of_normals(features)
    sky = points and normals is not None
    mesh = "mesh" in features.lights and not features.instances
    look_up, shading_normal = shading.look_up, shading.shading_normal

    @wp.func
    def sky_points(wave: Wave, light: int, count: int):
        """Of sky_point, to sky_x, sky_y and sky_z. light: the sky's number."""
        i = int(0)
        while i < count:
            point = sky_point(light_numbers(bits_at(wave.keys, i), bits_at(wave.indices, i), light))
            put_number(wave.sky_x, i, point[0])
            put_number(wave.sky_y, i, point[1])
            put_number(wave.sky_z, i, point[2])
            i = i + 1

    @wp.func
    def sample_sky(wave: Wave, lighting: Lighting, count: int):
        """To the rows sky_wi and sky_weight."""
        background = lighting.background
        rows = wave.rows
        light = lighting.count
        i = int(0)
        while i < count:
            point = sky_point(light_numbers(bits_at(wave.keys, i), bits_at(wave.indices, i), light))
            sample = sky_sample(background, row_vec3(rows, wp.static(normals or 0), i), point)
            put_row_vec3(rows, wp.static(ROW["sky_wi"]), i, sample.wi)
            put_row_vec3(rows, wp.static(ROW["sky_weight"]), i, sample.weight)
            i = i + 1

    @wp.func
    def put_spheres(wave: Wave, surfaces: Surfaces, first: int, end: int):
        """What of the rows is needed here, for hits on spheres."""
        for j in range(first, end):
            k = wave.met[j]
            if wave.hits.prim_id[k] >= surfaces.n_triangles:
                s = found(wave, surfaces, j - first, k)
                put_row_vec3(wave.rows, wp.static(ROW["point"]), j - first, s.point)
                if wp.static(sky):
                    n = shading_normal(surfaces, s, look_up(surfaces, s), -wave.rays.direction[k])
                    put_row_vec3(wave.rows, wp.static(normals or 0), j - first, n)

    @wp.func
    def sample_mesh(wave: Wave, surfaces: Surfaces, lighting: Lighting, count: int):
        """As mesh_light with the first light, to the rows wi, weight and end. Emitters are chosen and gathered in between."""
        rows = wave.rows
        i = int(0)
        while i < count:
            xi = light_numbers(bits_at(wave.keys, i), bits_at(wave.indices, i), 0)
            put_row_number(rows, wp.static(ROW["within"]), i, xi[0])
            put_row_number(rows, wp.static(ROW["across"]), i, xi[1])
            i = i + 1
        light = lighting.lights[0]
        for i in range(count):
            chosen, within = choose_emitter(lighting, light, row_number(rows, wp.static(ROW["within"]), i))
            emitter = lighting.emitters[chosen]
            material = surfaces.materials[emitter.material]
            put_row_number(rows, wp.static(ROW["within"]), i, within)
            put_row_vec3(rows, wp.static(ROW["e0"]), i, emitter.v0)
            put_row_vec3(rows, wp.static(ROW["e1"]), i, emitter.v1)
            put_row_vec3(rows, wp.static(ROW["e2"]), i, emitter.v2)
            put_row_vec3(rows, wp.static(ROW["normal"]), i, emitter.normal)
            put_row_vec3(rows, wp.static(ROW["emission"]), i, material.emission)
            put_row_number(rows, wp.static(ROW["pdf_area"]), i, emitter.pdf_area)
            put_row_number(rows, wp.static(ROW["two_sided"]), i, float(material.two_sided))
        i = int(0)
        while i < count:
            t = Triangle()
            t.v0 = row_vec3(rows, wp.static(ROW["e0"]), i)
            t.v1 = row_vec3(rows, wp.static(ROW["e1"]), i)
            t.v2 = row_vec3(rows, wp.static(ROW["e2"]), i)
            u, v = triangle_numbers(row_number(rows, wp.static(ROW["within"]), i), row_number(rows, wp.static(ROW["across"]), i))
            sample = from_emitter(triangle_point(t, u, v), triangle_point_error(t, u, v),
                                  row_vec3(rows, wp.static(ROW["normal"]), i), row_vec3(rows, wp.static(ROW["emission"]), i),
                                  row_number(rows, wp.static(ROW["two_sided"]), i) != 0.0,
                                  row_number(rows, wp.static(ROW["pdf_area"]), i), row_vec3(rows, wp.static(ROW["point"]), i))
            put_row_vec3(rows, wp.static(ROW["wi"]), i, sample.wi)
            put_row_vec3(rows, wp.static(ROW["weight"]), i, sample.weight)
            put_row_vec3(rows, wp.static(ROW["end"]), i, sample.end)
            i = i + 1

    @wp.func
    def sample_lights(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        if wp.static(features.spheres and (sky or mesh)):
            put_spheres(wave, surfaces, first, end)
        if wp.static(sky):
            sample_sky(wave, lighting, end - first)
        elif wp.static(points):
            sky_points(wave, lighting.count, end - first)
        if wp.static(mesh):
            if first_is_mesh(lighting):
                sample_mesh(wave, surfaces, lighting, end - first)

    @wp.func
    def light_at(wave: Wave, surfaces: Surfaces, lighting: Lighting, s: Surface, key: wp.uint32, index: wp.uint32, light: int,
                 i: int) -> LightSample:
        if wp.static(mesh):
            if light == 0 and first_is_mesh(lighting):
                out = LightSample()
                out.wi = row_vec3(wave.rows, wp.static(ROW["wi"]), i)
                out.weight = row_vec3(wave.rows, wp.static(ROW["weight"]), i)
                out.end = row_vec3(wave.rows, wp.static(ROW["end"]), i)
                out.area = 1
                return out
        if wp.static(points):
            if light == lighting.count:
                if wp.static(sky):
                    sky_light = LightSample()
                    sky_light.wi = row_vec3(wave.rows, wp.static(ROW["sky_wi"]), i)
                    sky_light.weight = row_vec3(wave.rows, wp.static(ROW["sky_weight"]), i)
                    sky_light.distant = 1
                    sky_light.area = 1
                    return sky_light
                return choose(lighting, surfaces, light, s, wp.vec3(wave.sky_x[i], wave.sky_y[i], wave.sky_z[i]))
        return choose(lighting, surfaces, light, s, light_point(lighting, key, index, light))

    return sample_lights, light_at, points or mesh
