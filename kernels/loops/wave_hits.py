"""A wave's hits: surfaces, texels, shading normals and random numbers, in vectorised loops over a block of at most BLOCK hits.

Each `make_...` returns the function that fills the rows of a block (None if the scene's hits are computed one by one), and the function
that returns the value of one hit: from the rows, or by the function that one_ray.py calls."""

from typing import Any

import warp as wp

from wrt.kernels.loops.state import BLOCK, FACETS, HITS, KEYS, NORMALS, SPHERES, SURFACES, TEXELS, Key, SphereHit, TriangleHit, Wave
from wrt.kernels.parameters import TEXTURES, Texels
from wrt.kernels.query import load_hit, load_render_ray
from wrt.kernels.rows import Rows, numbers_of, prefetch
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.sampling import where_vec3
from wrt.kernels.shade.shading import bump, textures_of
from wrt.kernels.shade.surface import Place, Surface, facing, make_on_sphere, make_on_triangle, make_triangle_at, visible_normal
from wrt.kernels.structs import Surfaces, noinline

store_sphere = SPHERES.store()
store_key = KEYS.store()
FAR = 16  # Number of hits between the prefetch of a triangle's corners and their load.


# --- surfaces ---------------------------------------------------------------------------------------------------------


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
            material = surfaces.prim_material[prim_id]
            hit.material = material
            if wp.static(tangents):
                hit.is_mapped = wp.where(surfaces.materials[material].normal_texture >= 0, 1, 0)
                hit.normal_scale = surfaces.materials[material].normal_scale
            hit.u = wave.queue.hits.u[k]
            hit.v = wave.queue.hits.v[k]
            hit.direction = wave.queue.rays.direction[k]
            store_hit(wave.rows, j - first, hit)
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
        store_sphere(wave.rows, j - first, hit)


@wp.func_native("".join(f"if (condition) {number} = {other};\n" for number, other in zip(
    numbers_of(Surface, "surface"), numbers_of(Surface, "value"), strict=True)))
def replace_where(condition: bool, value: Surface, surface: wp.ref[Surface]) -> None: ...


def make_replace_spheres(has: Attributes) -> Any:
    """Return replace_spheres(rows, count): put the surfaces of the spheres in SPHERES in the rows SURFACES, where the ray hit one."""
    on_sphere = make_on_sphere(has.uvs, has.tangents)
    load_direction, load_sphere = HITS.field("direction").load(), SPHERES.load()
    load_surface, store_surface = SURFACES.load(*has.not_of_surfaces), SURFACES.store(*has.not_of_surfaces)

    @wp.func
    def replace_spheres(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            hit = load_sphere(rows, i)
            surface = load_surface(rows, i)
            replace_where(hit.is_hit != 0, facing(on_sphere(hit.sphere, hit.point), load_direction(rows, i)), surface)
            store_surface(rows, i, surface)
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
        rows = wave.rows
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


def make_wave_surfaces(features: Features, surface_at: Any) -> tuple[Any, Any]:
    """Return compute_surfaces, and hit_surface(wave, surfaces, i, k) -> Surface of hit i of the block, at place k of the queue.

    With instances, compute_surfaces is None, and hit_surface calls `surface_at`."""
    has = Attributes(features)
    load_surface = SURFACES.load(*has.not_of_surfaces)

    @wp.func
    def single_hit_surface(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        return surface_at(surfaces, load_render_ray(wave.queue.rays, k), load_hit(wave.queue.hits, k))

    @wp.func
    def hit_surface(wave: Wave, surfaces: Surfaces, i: int, k: int) -> Surface:
        prim_id = wave.queue.hits.prim_id[k]
        s = load_surface(wave.rows, i)
        s.material = surfaces.prim_material[prim_id]
        s.exclude_plus_one = prim_id + 1
        if wp.static(has.spheres):
            s.exclude_plus_one = wp.where(prim_id < surfaces.n_triangles, prim_id + 1, 0)
        return s

    return (None, single_hit_surface) if features.instances else (make_compute_surfaces(has), hit_surface)


# --- texels -----------------------------------------------------------------------------------------------------------


def textures_vectorised(features: Features) -> bool:
    """Return whether textures are sampled for a block of hits at a time."""
    return features.textures and not features.checkerboards and not features.instances


def make_sample_texture(name: str) -> Any:
    """Return sample_texture(surfaces, rows, count): store texels of one entry of TEXTURES, at `count` hits, in the rows TEXELS."""
    material, u, v = (rows.first * BLOCK for rows in (HITS.field("material"), SURFACES.field("u"), SURFACES.field("v")))
    channels = sum(1 << channel for channel in TEXTURES[name].channels)
    to = TEXELS.field(TEXTURES[name].parameters[0]).first * BLOCK

    @wp.func_native(f"""
    int wanted[{BLOCK}];
    for (int i = 0; i < {BLOCK}; ++i) {{
        int material = -1;
        if (i < count) memcpy(&material, rows.data + {material} + i, sizeof(material));
        wanted[i] = material < 0 ? -1 : surfaces.materials.data[material].{name};
    }}
    wrt::sample_texture<{BLOCK}>(surfaces, wanted, rows.data + {u}, rows.data + {v}, count, {channels}, rows.data + {to});
    """)
    def sample_texture(surfaces: Surfaces, rows: wp.array(dtype=wp.float32), count: int) -> None: ...

    return sample_texture


def make_link(sample: Any, sample_others: Any) -> Any:
    """Return the function that calls `sample_others` and then `sample`."""

    @noinline
    def sample_all(surfaces: Surfaces, rows: wp.array(dtype=wp.float32), count: int):
        sample_others(surfaces, rows, count)
        sample(surfaces, rows, count)

    return sample_all


def make_wave_textures(features: Features, look_up: Any) -> tuple[Any, Any]:
    """Return sample(surfaces, rows, count) or None, and texels_at(wave, surfaces, surface, i) -> Texels of hit i of the block.

    If `sample` is None, texels_at calls `look_up` (from make_shading)."""
    textures = textures_of(features) if textures_vectorised(features) else {}
    sample = None
    for name in textures:
        sample = make_link(make_sample_texture(name), sample) if sample else make_sample_texture(name)
    load = TEXELS.load(*(field for name in TEXTURES.keys() - textures.keys() for field in TEXTURES[name].parameters))

    @wp.func
    def texels_at(wave: Wave, surfaces: Surfaces, s: Surface, i: int) -> Texels:
        if wp.static(not textures):
            return look_up(surfaces, s)
        return load(wave.rows, i)

    return sample, texels_at


# --- shading normals --------------------------------------------------------------------------------------------------


def normal_rows(features: Features) -> Rows | None:
    """Return the rows that hold the shading normals; None if normals are computed one by one."""
    if features.instances or (features.normal_maps and not textures_vectorised(features)):
        return None
    return NORMALS if features.smooth or features.normal_maps else SURFACES.field("shading")


def make_wave_normals(features: Features, shading_normal: Any) -> tuple[Any, Any]:
    """Return compute_normals(rows, count) or None, and normal_at(wave, surfaces, surface, texels, wo, i) -> vec3 for hit i of the block.

    The normals are on the side of the rays' origins. If compute_normals is None, normal_at calls `shading_normal` (from make_shading)."""
    vectorised = normal_rows(features) == NORMALS
    load_hit, load_surface, load_color = HITS.load(), SURFACES.load(), TEXELS.field("normal").load()
    load_normal, store_normal = NORMALS.load(), NORMALS.store()

    @noinline
    def compute_normals(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            hit = load_hit(rows, i)
            s = load_surface(rows, i)
            n = s.shading
            if wp.static(features.normal_maps):
                n = where_vec3(hit.is_mapped != 0, bump(s, hit.normal_scale, load_color(rows, i)), n)
            store_normal(rows, i, visible_normal(n, -hit.direction))
            i = i + 1

    @wp.func
    def normal_at(wave: Wave, surfaces: Surfaces, s: Surface, texels: Texels, wo: wp.vec3, i: int) -> wp.vec3:
        if wp.static(not vectorised):
            return shading_normal(surfaces, s, texels, wo)
        return load_normal(wave.rows, i)

    return compute_normals if vectorised else None, normal_at


# --- random numbers ---------------------------------------------------------------------------------------------------


@noinline
def store_keys(wave: Wave, first: int, end: int):
    """Store the keys of the hits first .. end - 1, at most BLOCK, in the rows KEYS: Path.key of the path whose ray was just traced."""
    task = wave.task[0]
    for j in range(first, end):
        s = wave.queue.sample[wave.outcomes.hit_rays[j]]
        out = Key()
        if wave.progress[0].fresh != 0:
            out.key = wave.pixels.key[s / task.samples]
        else:
            out.key = wave.samples.paths[wave.samples.pending[s] * wave.capacity + s].key
        out.index = wp.uint32(task.first_sample + s % task.samples)
        store_key(wave.rows, j - first, out)


def make_sample_facets(choose_facet: Any) -> Any:
    """Return sample_facets(wave, count): store the results of choose_facet for `count` hits in the rows FACETS."""
    load_key, store_facet = KEYS.load(), FACETS.store()

    @noinline
    def sample_facets(wave: Wave, count: int):
        rows = wave.rows
        i = int(0)
        while i < count:
            at = load_key(rows, i)
            store_facet(rows, i, choose_facet(at.key, at.index))
            i = i + 1

    return sample_facets
