"""A material: reflects the same share of light at every angle, back to its source."""

import warp as wp

from wrt.kernels.parameters import Material
from wrt.kernels.shade import materials as device
from wrt.kernels.shade.materials import Scatter
from wrt.kernels.shade.surface import Surface
from wrt.scene.materials import MATERIALS, MaterialKind


@wp.func
def retroreflector(m: Material, s: Surface, n: wp.vec3, wo: wp.vec3, out: Scatter) -> Scatter:
    result = out
    result.reflected = m.albedo
    result.reflection = wo
    return result


MATERIALS["retroreflector"] = MaterialKind("reflectance albedo back to the light")
device.MATERIALS["retroreflector"] = lambda features: retroreflector
