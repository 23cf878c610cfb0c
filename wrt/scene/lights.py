"""Lights without a surface: one class a kind, and a row in LIGHTS. (What has a surface lights by its material's emission.)"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrt.core.checks import at_thing
from wrt.core.errors import InputError
from wrt.scene.kinds import Kind, given
from wrt.scene.values import Color, as_number


class Light(Kind):
    """What every kind of light is; its device function stands in kernels/shade/lights.py, under the same name."""

    what = "light"


@dataclass(frozen=True)
class PointLight(Light):
    """A point that shines alike in all directions."""

    kind = "point"
    position: Color = field(metadata=given("point", "where it is"))
    intensity: Color = field(metadata=given(
        "color", "the same in all directions; irradiance falls with the square of the distance", "radiant intensity"))
    name: str = ""

    def record(self) -> dict[str, Any]:
        return {"position": self.position, "color": self.intensity}


@dataclass(frozen=True)
class DirectionalLight(Light):
    """A light at infinity."""

    kind = "directional"
    direction: Color = field(metadata=given("direction", "the way the light travels (any length)"))
    irradiance: Color = field(metadata=given("color", "on a surface that faces it", "irradiance"))
    name: str = ""

    def record(self) -> dict[str, Any]:
        return {"direction": self.direction, "color": self.irradiance}


@dataclass(frozen=True)
class SpotLight(Light):
    """A point light in a cone.

    Full light within `inner` of its axis, none beyond `outer`, and between them the square of a linear ramp in the cosine, as
    KHR_lights_punctual recommends.
    """

    kind = "spot"
    position: Color = field(metadata=given("point", "where it is"))
    direction: Color = field(metadata=given("direction", "axis of the cone (any length)"))
    intensity: Color = field(metadata=given("color", "on the axis", "radiant intensity"))
    inner: float = field(default=0.0, metadata=given("angle", "half angle of full light", ge=0.0, le=90.0))
    outer: float = field(default=math.pi / 4, metadata=given("angle", "half angle without light beyond", gt=0.0, le=90.0))
    name: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        at = at_thing("light", self.name)
        as_number(self.outer, at + "outer", low=1e-4)
        if self.inner > self.outer:
            inner, outer = math.degrees(self.inner), math.degrees(self.outer)
            raise InputError(at + f"inner ({inner:.6g} degrees) must not be larger than outer ({outer:.6g})")

    def record(self) -> dict[str, Any]:
        return {"position": self.position, "color": self.intensity, "direction": self.direction,
                "cos_inner": np.cos(self.inner), "cos_outer": np.cos(self.outer)}


LIGHTS: dict[str, type[Light]] = {each.kind: each for each in (PointLight, DirectionalLight, SpotLight)}
EMISSIVE = ("mesh", "sphere")  # the device's kinds that stand for emissive surfaces
