"""Lights without a surface: one class and one entry of LIGHTS for each kind. Area lights are surfaces with an emissive material."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import wrong
from wrt.scene.kinds import Kind, Record, given
from wrt.scene.values import ROUNDING, Color, as_number


class Light(Kind):
    """Base class of lights. kernels/shade/lights.py has the device functions of each `kind`."""

    what = "light"


@dataclass(frozen=True)
class PointLight(Light):
    """A point that emits equally in all directions: irradiance = intensity / distance^2."""

    kind = "point"
    position: Color = field(metadata=given("point", "position"))
    intensity: Color = field(metadata=given("color", "in every direction; irradiance = intensity / distance^2", "radiant intensity"))
    name: str = ""

    def record(self) -> Record:
        return {"position": self.position, "color": self.intensity}


@dataclass(frozen=True)
class DirectionalLight(Light):
    """Parallel light from infinity."""

    kind = "directional"
    direction: Color = field(metadata=given("direction", "direction in which the light travels, of any length"))
    irradiance: Color = field(metadata=given("color", "of a surface that faces the light", "irradiance"))
    name: str = ""

    def record(self) -> Record:
        return {"direction": self.direction, "color": self.irradiance}


@dataclass(frozen=True)
class SpotLight(Light):
    """A point light limited to a cone.

    The light has its full intensity up to the angle `inner` from the axis, and none beyond `outer`. Between these half angles (radians)
    a factor falls from 1 to 0: the square of a linear ramp in the cosine, as KHR_lights_punctual recommends."""

    kind = "spot"
    position: Color = field(metadata=given("point", "position"))
    direction: Color = field(metadata=given("direction", "axis of the cone, of any length"))
    intensity: Color = field(metadata=given("color", "along the axis", "radiant intensity"))
    inner: float = field(default=0.0, metadata=given("angle", "half angle of full intensity", ge=0.0, le=90.0))
    outer: float = field(default=math.pi / 4, metadata=given("angle", "half angle beyond which there is no light", gt=0.0, le=90.0))
    name: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        at = at_thing("light", self.name)
        as_number(self.outer, at + "outer", low=1e-4)
        if self.inner <= self.outer * (1.0 + ROUNDING):
            object.__setattr__(self, "inner", min(self.inner, self.outer))
        else:
            inner, outer = math.degrees(self.inner), math.degrees(self.outer)
            raise wrong(at + "inner", f"must be at most outer ({outer:.6g} degrees), got {inner:.6g} degrees")

    def record(self) -> Record:
        return {"position": self.position, "color": self.intensity, "direction": self.direction,
                "cos_inner": np.cos(self.inner), "cos_outer": np.cos(self.outer)}


LIGHTS: dict[str, type[Light]] = {each.kind: each for each in (PointLight, DirectionalLight, SpotLight)}
EMISSIVE = ("mesh", "sphere")  # the device's kinds of emissive surfaces
