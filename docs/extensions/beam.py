"""A light: a parallel beam of round cross-section."""

from dataclasses import dataclass, field

import warp as wp

from wrt.kernels import structs
from wrt.kernels.shade import lights as device
from wrt.kernels.shade.lights import LightSample
from wrt.kernels.shade.surface import Surface
from wrt.scene.kinds import given
from wrt.scene.lights import LIGHTS, Light
from wrt.scene.values import Color


@dataclass(frozen=True)
class BeamLight(Light):
    """A parallel beam."""

    kind = "beam"
    position: Color = field(metadata=given("point", "the centre of its start"))
    direction: Color = field(metadata=given("direction", "the way the light travels"))
    irradiance: Color = field(metadata=given("color", "on a surface that faces it", "irradiance"))
    radius: float = field(default=0.1, metadata=given("number", "of the beam", "length", gt=0.0))
    name: str = ""

    def record(self):
        return {"position": self.position, "direction": self.direction, "color": self.irradiance, "radius": self.radius}


@wp.func
def beam(lighting: structs.Lighting, surfaces: structs.Surfaces, light: structs.Light, s: Surface, xi: wp.vec2) -> LightSample:
    sample = LightSample()
    way = s.point - light.position
    along = wp.dot(way, light.direction)
    if along > 0.0 and wp.length(way - along * light.direction) < light.radius:
        sample.wi = -light.direction
        sample.end = s.point - along * light.direction
        sample.weight = light.color
    return sample


LIGHTS["beam"] = BeamLight
device.LIGHTS["beam"] = lambda features: beam
device.WITHOUT_AREA.add("beam")  # A single sample: no random numbers.
