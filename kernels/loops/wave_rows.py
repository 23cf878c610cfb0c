"""The rows of a block: what is gathered and computed for BLOCK hits of a wave at a time, each struct in rows of its own."""

import warp as wp

from wrt.kernels.loops.state import BLOCK
from wrt.kernels.rows import Rows
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.shading import Texels
from wrt.kernels.shade.surface import Surface, Triangle
from wrt.kernels.structs import Emitter


@wp.struct
class Met:
    """What a surface is computed from: its triangle, the hit's barycentrics, and the ray's direction."""

    triangle: Triangle
    u: float
    v: float
    direction: wp.vec3


@wp.struct
class NormalMap:
    """What a material says of its normal map. is_mapped: 1 where it has one."""

    scale: float
    is_mapped: int


@wp.struct
class Numbers:
    """What places a sample on a light, in [0, 1): two numbers, since a vector of two would not run in lanes."""

    x: float
    y: float


@wp.struct
class Key:
    """What a hit's numbers are made from: of its path's vertex, and of its sample."""

    key: wp.uint32
    index: wp.uint32


@wp.struct
class EmitterPoint:
    """A point on an emitter. emission, two_sided: of its material; numbers: what triangle_numbers makes barycentrics of."""

    emitter: Emitter
    emission: wp.vec3
    two_sided: int
    numbers: Numbers


HITS = Rows(Met, BLOCK)
SURFACES = Rows(Surface, BLOCK, HITS.end)
TEXELS = Rows(Texels, BLOCK, SURFACES.end)
NORMAL_MAPS = Rows(NormalMap, BLOCK, TEXELS.end)
BENT = Rows(wp.vec3, BLOCK, NORMAL_MAPS.end)  # the shading normal as lights see it
KEYS = Rows(Key, BLOCK, BENT.end)
FACETS = Rows(wp.vec3, BLOCK, KEYS.end)  # what chooses a microfacet
NUMBERS = Rows(Numbers, BLOCK, FACETS.end)
EMITTERS = Rows(EmitterPoint, BLOCK, NUMBERS.end)
LIGHTS = Rows(LightSample, BLOCK, EMITTERS.end)  # of the first light
SKY = Rows(LightSample, BLOCK, LIGHTS.end)
SKY_POINTS = Rows(wp.vec3, BLOCK, SKY.end)  # what places a sample on the sky (sky_point)
MISSED = Rows(wp.vec3, BLOCK, SKY_POINTS.end)  # directions of a block of the rays that missed
SEEN = Rows(wp.vec3, BLOCK, MISSED.end)  # and the background's colours there
ROWS = SEEN.end
