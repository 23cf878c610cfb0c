"""The rows of a block: what is gathered and computed for BLOCK hits of a wave at a time, each struct in rows of its own."""

import warp as wp

from wrt.kernels.loops.state import BLOCK
from wrt.kernels.rows import Rows
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.shading import Texels
from wrt.kernels.shade.surface import Surface, Triangle
from wrt.kernels.structs import Emitter


@wp.struct
class TriangleHit:
    """What a surface is computed from: its triangle, the hit's barycentrics, the ray's direction, and the material: -1 where a
    sphere is hit. is_mapped: 1 where the material has a normal map."""

    triangle: Triangle
    u: float
    v: float
    direction: wp.vec3
    material: int
    is_mapped: int
    normal_scale: float


@wp.struct
class Key:
    """What a hit's numbers are made from: of its path's vertex, and of its sample."""

    key: wp.uint32
    index: wp.uint32


@wp.struct
class EmitterPoint:
    """A point on an emitter. emission, two_sided: of its material; xi: what places it, in [0, 1)."""

    emitter: Emitter
    emission: wp.vec3
    two_sided: int
    xi: wp.vec2


HITS = Rows(TriangleHit, BLOCK)
SURFACES = Rows(Surface, BLOCK, HITS.end)
TEXELS = Rows(Texels, BLOCK, SURFACES.end)
NORMALS = Rows(wp.vec3, BLOCK, TEXELS.end)  # the shading normal as lights see it
KEYS = Rows(Key, BLOCK, NORMALS.end)
FACETS = Rows(wp.vec3, BLOCK, KEYS.end)  # what chooses a microfacet
EMITTERS = Rows(EmitterPoint, BLOCK, FACETS.end)
LIGHTS = Rows(LightSample, BLOCK, EMITTERS.end)  # of the first light
SKY = Rows(LightSample, BLOCK, LIGHTS.end)
SKY_POINTS = Rows(wp.vec3, BLOCK, SKY.end)  # what places a sample on the sky (sky_point)
MISS_DIRECTIONS = Rows(wp.vec3, BLOCK, SKY_POINTS.end)  # directions of a block of the rays that missed
MISS_COLORS = Rows(wp.vec3, BLOCK, MISS_DIRECTIONS.end)  # and the background's colours there
ROWS = MISS_COLORS.end
