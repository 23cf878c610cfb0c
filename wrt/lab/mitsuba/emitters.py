"""Translate lights and backgrounds to Mitsuba."""

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from wrt.core.errors import InputError
from wrt.lab.mitsuba.bsdfs import Plugin, refuse, rgb
from wrt.scene.backgrounds import Background, EnvironmentBackground, GradientBackground
from wrt.scene.lights import Light, SpotLight

# Rows of a gradient's picture: linear interpolation of a cosine over steps of pi / 1024 has an error of at most 1.2e-6.
GRADIENT_ROWS = 1025
SPOT_TEXELS = 1024  # columns and rows of the texture that holds a spot light's falloff
WIDEST_SPOT = math.radians(80.0)  # largest half angle of a spot light with a soft edge


def light_emitter(mi: ModuleType, light: Light) -> Plugin:
    """Return a light as a dictionary for `mitsuba.load_dict`."""
    if light.kind not in LIGHTS:
        refuse(f"light {light.name!r} of kind {light.kind!r}")
    return LIGHTS[light.kind](mi, light)


def _spot(mi: ModuleType, light: SpotLight) -> Plugin:
    """Return a spot light as a dictionary for `mitsuba.load_dict`; the light's projected texture holds wrt's falloff.
    Mitsuba's own falloff is linear in the angle, so `beam_width` switches it off. Raise InputError if a soft edge ends beyond 80
    degrees from the axis."""
    direction = np.array(light.direction)
    up = np.eye(3)[int(np.argmin(np.abs(direction)))]
    cutoff = math.degrees(light.outer)
    target = np.array(light.position) + direction
    spot: Plugin = {
        "type": "spot", "intensity": rgb(light.intensity), "cutoff_angle": cutoff, "beam_width": cutoff * (1.0 - 1e-6),
        "to_world": mi.ScalarTransform4f().look_at(list(light.position), target.tolist(), up.tolist()),
    }
    if light.inner >= light.outer:
        return spot
    if light.outer > WIDEST_SPOT:
        refuse("a soft spot light of more than 80 degrees from its axis", f"light {light.name!r}")
    x = (2.0 * (np.arange(SPOT_TEXELS) + 0.5) / SPOT_TEXELS - 1.0) * math.tan(light.outer)
    cosine = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + x[:, None] ** 2)
    ramp = (cosine - math.cos(light.outer)) / (math.cos(light.inner) - math.cos(light.outer))
    falloff = np.clip(ramp, 0.0, 1.0) ** 2
    texels = np.ascontiguousarray(np.repeat(falloff[..., None], 3, axis=2), np.float32)
    return spot | {"texture": {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True, "wrap_mode": "clamp"}}


LIGHTS: dict[str, Callable[[Any, Any], Plugin]] = {
    "point": lambda mi, light: {"type": "point", "position": list(light.position), "intensity": rgb(light.intensity)},
    "directional": lambda mi, light: {
        "type": "directional", "direction": list(light.direction), "irradiance": rgb(light.irradiance)},
    "spot": _spot,
}


def background_emitter(mi: ModuleType, background: Background) -> Plugin | None:
    """Return the background as an emitter, or None for constant black.
    Raise InputError for an environment picture of fewer than 3 columns, and for a kind that is not in BACKGROUNDS."""
    if background.kind not in BACKGROUNDS:
        raise InputError(f"not translatable: a background of kind {background.kind!r}", place="Mitsuba")
    return BACKGROUNDS[background.kind](mi, background)


def _gradient(mi: ModuleType, background: GradientBackground) -> Plugin:
    height = np.cos(np.linspace(0.0, math.pi, GRADIENT_ROWS))[:, None]
    share = 0.5 * (height + 1.0)
    rows = share * np.array(background.top) + (1.0 - share) * np.array(background.bottom)
    picture = np.repeat(rows[:, None, :], 4, axis=1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(picture, np.float32))}


def _environment(mi: ModuleType, background: EnvironmentBackground) -> Plugin:
    image = background.image
    if image.shape[1] < 3:
        raise InputError(f"Mitsuba needs a picture of 3 columns or more, got {image.shape[1]}", place=f"environment {background.name!r}")
    # Mitsuba's first and last row lie at the poles, wrt's lie half a row from them. Both interpolate linearly between rows. So a picture
    # in which rows alternate with the means of neighbouring rows is the same function.
    above, below = np.concatenate([image[:1], image]), np.concatenate([image, image[-1:]])
    rows = np.empty((2 * len(image) + 1, *image.shape[1:]), np.float32)
    rows[0::2] = 0.5 * (above + below)
    rows[1::2] = image
    # -z is the left edge of Mitsuba's picture, but the middle of wrt's: turn by 180 degrees.
    turn = mi.ScalarTransform4f().rotate([0.0, 1.0, 0.0], math.degrees(background.rotation) + 180.0)
    return {"type": "envmap", "bitmap": mi.Bitmap(rows), "scale": background.scale, "to_world": turn}


BACKGROUNDS: dict[str, Callable[[Any, Any], Plugin | None]] = {
    "constant": lambda mi, sky: {"type": "constant", "radiance": rgb(sky.color)} if max(sky.color) > 0.0 else None,
    "gradient": _gradient, "environment": _environment}
