"""The layout of a block (kernels/rows.py): each struct that vectorised loops load and store for BLOCK hits has its own rows."""

import warp as wp

from wrt.kernels.loops.state import BLOCK
from wrt.kernels.rows import Rows
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.shading import Texels
from wrt.kernels.shade.surface import Surface, Triangle
from wrt.kernels.structs import Emitter


@wp.struct
class TriangleHit:
    """A hit, with the data of its triangle for its Surface and shading normal. If it is on a sphere, the triangle is any triangle."""

    triangle: Triangle
    u: float  # Barycentric of corner v1.
    v: float  # Barycentric of corner v2.
    direction: wp.vec3  # The ray's direction.
    material: int  # Material of the triangle or sphere.
    is_mapped: int  # 1 if the material has a normal map.
    normal_scale: float  # Material.normal_scale.


@wp.struct
class SphereHit:
    """A sphere and a hit point, with the data for its Surface."""

    sphere: wp.vec4  # Centre and radius, in world space.
    point: wp.vec3  # The ray's point at the hit.
    is_hit: int  # 1 if the ray hit this sphere; 0 if it hit a triangle.


@wp.struct
class Key:
    """The seed of a hit's random numbers: its path's key, and its sample's index."""

    key: wp.uint32
    index: wp.uint32


@wp.struct
class EmitterPoint:
    """A sampled point on an emitter."""

    emitter: Emitter
    emission: wp.vec3  # Emission of the emitter's material.
    two_sided: int  # 1 if the emitter's material emits on both sides.
    xi: wp.vec2  # Places the point on the emitter, in [0, 1)^2.


@wp.struct
class Drawn:
    """Tells where the background's sample for a hit is, if only some hits of a block have one."""

    i: int  # Its index in the rows SKY; -1: there is none.


HITS = Rows(TriangleHit, BLOCK)
SPHERES = Rows(SphereHit, BLOCK, HITS.end)
SURFACES = Rows(Surface, BLOCK, SPHERES.end)
TEXELS = Rows(Texels, BLOCK, SURFACES.end)
NORMALS = Rows(wp.vec3, BLOCK, TEXELS.end)  # Shading normals on the viewer's side.
KEYS = Rows(Key, BLOCK, NORMALS.end)
FACETS = Rows(wp.vec3, BLOCK, KEYS.end)  # Results of choose_facet.
EMITTERS = Rows(EmitterPoint, BLOCK, FACETS.end)
LIGHTS = Rows(LightSample, BLOCK, EMITTERS.end)  # Samples of light 0, if it is a mesh.
SKY = Rows(LightSample, BLOCK, LIGHTS.end)  # Samples of the background.
SKY_POINTS = Rows(wp.vec3, BLOCK, SKY.end)  # Results of sky_point.
DRAWN = Rows(Drawn, BLOCK, SKY_POINTS.end)
MISS_DIRECTIONS = Rows(wp.vec3, BLOCK, DRAWN.end)  # Directions of missed rays.
MISS_COLORS = Rows(wp.vec3, BLOCK, MISS_DIRECTIONS.end)  # The background's radiance in these directions.
ROWS = MISS_COLORS.end
