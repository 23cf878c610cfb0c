"""Lights without a surface: point, directional, spot. (What has a surface lights by its material's emission.)"""

from __future__ import annotations

import math
from dataclasses import dataclass

from wrt.core.checks import at_thing
from wrt.scene.values import Color, _unit, as_number, as_vector


@dataclass(frozen=True)
class PointLight:
    """intensity: radiant intensity (per steradian); irradiance falls with the square of the distance."""

    position: Color
    intensity: Color
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", as_vector(self.position, at_thing("light", self.name) + "position"))
        object.__setattr__(self, "intensity", as_vector(self.intensity, at_thing("light", self.name) + "intensity", low=0.0))


@dataclass(frozen=True)
class DirectionalLight:
    """direction: the way the light travels (any length but 0); irradiance: on a surface that faces it."""

    direction: Color
    irradiance: Color
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("light", self.name)
        object.__setattr__(self, "direction", _unit(as_vector(self.direction, at + "direction"), at + "direction"))
        object.__setattr__(self, "irradiance", as_vector(self.irradiance, at + "irradiance", low=0.0))


@dataclass(frozen=True)
class SpotLight:
    """A point light in a cone: full within `inner` of its axis, none beyond `outer` (half angles in radians), and between
    them the square of a linear ramp in the cosine, as KHR_lights_punctual recommends."""

    position: Color
    direction: Color
    intensity: Color
    inner: float = 0.0
    outer: float = math.pi / 4
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("light", self.name)
        object.__setattr__(self, "position", as_vector(self.position, at + "position"))
        object.__setattr__(self, "direction", _unit(as_vector(self.direction, at + "direction"), at + "direction"))
        object.__setattr__(self, "intensity", as_vector(self.intensity, at + "intensity", low=0.0))
        object.__setattr__(self, "outer", as_number(self.outer, at + "outer", low=1e-4, high=math.pi / 2))
        object.__setattr__(self, "inner", as_number(self.inner, at + "inner", low=0.0, high=self.outer))


Light = PointLight | DirectionalLight | SpotLight
