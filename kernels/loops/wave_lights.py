"""Light samples for a wave's hits. Samples of the background (sky), and of light 0 if it is a mesh, are vectorised."""

from typing import Any, NamedTuple

import warp as wp

from wrt.kernels.loops.state import DRAWN, EMITTERS, KEYS, LIGHTS, SKY, SKY_POINTS, SURFACES, Drawn, EmitterPoint, Key, Wave
from wrt.kernels.loops.wave_hits import normal_rows
from wrt.kernels.rows import Rows
from wrt.kernels.shade import lights as kinds
from wrt.kernels.shade.backgrounds import BACKGROUNDS, make_sky_point, make_sky_sample
from wrt.kernels.shade.direct import make_light_points
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.lights import LightSample, choose_emitter, emitter_corners, from_emitter
from wrt.kernels.shade.sampling import triangle_numbers
from wrt.kernels.shade.surface import Surface, make_place_of, triangle_point, triangle_point_error
from wrt.kernels.structs import Lighting, Surfaces, noinline

MESH = list(kinds.LIGHTS).index("mesh")


@wp.func
def first_is_mesh(lighting: Lighting) -> bool:
    """Return whether light 0 is an emissive mesh."""
    if lighting.count == 0:
        return False
    return lighting.lights[0].kind == MESH


class BlockSamples:
    """Which light samples of a scene are computed for a whole block of hits at once."""

    def __init__(self, features: Features) -> None:
        kind = BACKGROUNDS[features.background]
        by_cosine = features.sky_light and kind.sample is None and kind.make_block_radiance is None
        self.normals: Rows | None = normal_rows(features)  # Rows of the shading normals, if they are stored.
        self.mesh = "mesh" in features.lights and not features.instances  # Samples of light 0, if it is a mesh.
        self.cosine = by_cosine and self.normals is not None  # Samples of the background by the cosine, which need normals.
        # Samples of the background by a function of its kind, for hits that may need one.
        self.by_kind = kind.make_block_samples(SKY_POINTS, SKY) if features.sky_light and kind.make_block_samples else None
        self.points = by_cosine and self.normals is None  # Of the background's samples, only the result of sky_point.


def make_keep_diffuse(features: Features) -> Any:
    """Return keep_diffuse(wave, surfaces, first, end) -> int: leave out the SKY_POINTS of hits that are not diffuse, and set DRAWN.

    The result is the number of points left. Clear materials are not diffuse: others may not be either, but then a sample does no harm."""
    place_of = make_place_of(features.instances)
    load_point, store_point, store_drawn = SKY_POINTS.load(), SKY_POINTS.store(), DRAWN.store()

    @wp.func
    def keep_diffuse(wave: Wave, surfaces: Surfaces, first: int, end: int) -> int:
        rows = wave.rows
        kept = int(0)
        for i in range(end - first):
            drawn = Drawn()
            drawn.i = -1
            place = place_of(surfaces, wave.queue.hits.prim_id[wave.outcomes.hit_rays[first + i]])
            material = place.material
            if surfaces.materials[material].transmission < 1.0:
                drawn.i = kept
                store_point(rows, kept, load_point(rows, i))
                kept += 1
            store_drawn(rows, i, drawn)
        return kept

    return keep_diffuse


def make_sample_sky(features: Features, sampled: BlockSamples) -> Any:
    """Return sample_sky(wave, surfaces, lighting, first, end): store background samples in the rows SKY, or sky_point's results in
    SKY_POINTS."""
    sky_point, sky_sample, light_xi = make_sky_point(features), make_sky_sample(features), make_light_points(features).xi
    load_key, load_normal = KEYS.load(), (sampled.normals or SURFACES.field("shading")).load()
    store_point, store_sample, by_kind = SKY_POINTS.store(), SKY.store("end", "distant", "area"), sampled.by_kind
    keep_diffuse = make_keep_diffuse(features)

    @wp.func
    def sample_sky(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        background = lighting.background
        count = end - first
        rows = wave.rows
        light = lighting.count
        i = int(0)
        while i < count:
            at = load_key(rows, i)
            point = sky_point(light_xi(at.key, at.index, light))
            if wp.static(sampled.cosine):
                store_sample(rows, i, sky_sample(background, load_normal(rows, i), point))
            else:
                store_point(rows, i, point)
            i = i + 1
        if wp.static(by_kind is not None):
            by_kind(background, rows, keep_diffuse(wave, surfaces, first, end))

    return sample_sky


def make_sample_mesh(features: Features) -> Any:
    """Return sample_mesh(wave, surfaces, lighting, count): store samples of light 0, a mesh, in the rows LIGHTS.

    Random numbers and samples are vectorised. Emitters are chosen and loaded one by one."""
    light_xi = make_light_points(features).xi
    load_key, load_xi, store_xi = KEYS.load(), EMITTERS.field("xi").load(), EMITTERS.field("xi").store()
    load_emitter, store_emitter = (make("emitter.material", "emitter.instance") for make in (EMITTERS.load, EMITTERS.store))
    load_eye, store_sample = SURFACES.field("point").load(), LIGHTS.store("distant", "area")

    @wp.func
    def draw(rows: wp.array(dtype=wp.float32), count: int):
        i = int(0)
        while i < count:
            at = load_key(rows, i)
            store_xi(rows, i, light_xi(at.key, at.index, 0))
            i = i + 1

    @wp.func
    def choose(rows: wp.array(dtype=wp.float32), surfaces: Surfaces, lighting: Lighting, count: int):
        light = lighting.lights[0]
        for i in range(count):
            at = EmitterPoint()
            xi = load_xi(rows, i)
            chosen, within = choose_emitter(lighting, light, xi[0])
            at.xi = wp.vec2(within, xi[1])
            at.emitter = lighting.emitters[chosen]
            material = at.emitter.material
            at.emission = surfaces.materials[material].emission
            at.two_sided = surfaces.materials[material].two_sided
            store_emitter(rows, i, at)

    @wp.func
    def sample_mesh(wave: Wave, surfaces: Surfaces, lighting: Lighting, count: int):
        rows = wave.rows
        draw(rows, count)
        choose(rows, surfaces, lighting, count)
        i = int(0)
        while i < count:
            at = load_emitter(rows, i)
            t = emitter_corners(at.emitter)
            u, v = triangle_numbers(at.xi[0], at.xi[1])
            sample = from_emitter(triangle_point(t, u, v), triangle_point_error(t, u, v), at.emitter.normal, at.emission,
                                  at.two_sided != 0, at.emitter.pdf_area, load_eye(rows, i))
            store_sample(rows, i, sample)
            i = i + 1

    return sample_mesh


@wp.struct
class Vertex:
    """A surface that requests shadow rays, and the key of its light samples."""

    surface: Surface
    key: Key
    i: int  # Index of the hit in the block.


def make_light_at(features: Features, sampled: BlockSamples, sample_light: Any) -> Any:
    """Return light_at(wave, surfaces, lighting, vertex, light) -> LightSample. It loads the sample from rows, or calls sample_light."""
    light_point = make_light_points(features).point
    load_light, load_sky, load_point = LIGHTS.load("distant", "area"), SKY.load("end", "distant", "area"), SKY_POINTS.load()
    load_drawn = DRAWN.load()

    @wp.func
    def sky_at(wave: Wave, i: int) -> LightSample:
        sky = load_sky(wave.rows, i)
        sky.distant = 1
        sky.area = 1
        return sky

    @wp.func
    def light_at(wave: Wave, surfaces: Surfaces, lighting: Lighting, vertex: Vertex, light: int) -> LightSample:
        if wp.static(sampled.mesh):
            if light == 0 and first_is_mesh(lighting):
                mesh = load_light(wave.rows, vertex.i)
                mesh.area = 1
                return mesh
        if wp.static(sampled.cosine):
            if light == lighting.count:
                return sky_at(wave, vertex.i)
        if wp.static(sampled.by_kind is not None):
            if light == lighting.count:
                drawn = load_drawn(wave.rows, vertex.i)
                if drawn.i >= 0:
                    return sky_at(wave, drawn.i)
        if wp.static(sampled.points):
            if light == lighting.count:
                return sample_light(lighting, surfaces, light, vertex.surface, load_point(wave.rows, vertex.i))
        point = light_point(lighting, vertex.key.key, vertex.key.index, light)
        return sample_light(lighting, surfaces, light, vertex.surface, point)

    return light_at


class WaveLights(NamedTuple):
    """The device functions for the light samples of a block of at most BLOCK hits."""

    sample: Any  # (wave, surfaces, lighting, first, end): store samples for the hits first .. end - 1, after their surfaces.
    at: Any  # The result of make_light_at.
    needs_keys: bool  # True if `sample` reads the rows KEYS.


def make_wave_lights(features: Features, sample_light: Any) -> WaveLights:
    """Return the WaveLights of a scene. sample_light comes from make_step."""
    sampled = BlockSamples(features)
    sky = sampled.cosine or sampled.by_kind is not None or sampled.points
    sample_sky, sample_mesh = make_sample_sky(features, sampled), make_sample_mesh(features)

    @noinline
    def sample(wave: Wave, surfaces: Surfaces, lighting: Lighting, first: int, end: int):
        if wp.static(sky):
            sample_sky(wave, surfaces, lighting, first, end)
        if wp.static(sampled.mesh):
            if first_is_mesh(lighting):
                sample_mesh(wave, surfaces, lighting, end - first)

    return WaveLights(sample, make_light_at(features, sampled, sample_light), sky or sampled.mesh)
