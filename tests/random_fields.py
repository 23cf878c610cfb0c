"""Random values for the fields of scene descriptions that `wrt.scene.kinds.given` declares.

A value is drawn in two steps. The first, with the generator of a group of scenes, draws what selects kernels: whether a field has
its default, flags, choices, kinds of textures. It returns a `Draw`, which draws the numbers of one scene with that scene's generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING
from typing import Any

import numpy as np

from wrt.core.checks import LARGEST
from wrt.core.errors import InputError
from wrt.scene.kinds import forms
from wrt.scene.materials import WRAPS, Texture
from wrt.scene.values import Limits

Rng = np.random.Generator
Draw = Callable[[Rng], Any]
LOW, HIGH = 0.02, 10.0  # range of numbers without limits, which are log-uniform
TRIES = 100  # draws until the values go together


def number(group: Rng, limits: Limits) -> Draw:
    """Draw a number: sometimes the upper limit, never the lower, because 0 often turns a feature off."""
    low = max(limits.get("ge", -math.inf), limits.get("gt", -math.inf))
    high = min(limits.get("le", math.inf), limits.get("lt", math.inf))
    if low < 0.0:
        return lambda rng: rng.normal()
    if high - low > 100.0:
        return lambda rng: math.exp(rng.uniform(math.log(max(low, LOW)), math.log(min(high, HIGH))))
    return lambda rng: high if rng.random() < 0.1 and "le" in limits else rng.uniform(low + 0.02 * (high - low), high)


def angle(group: Rng, limits: Limits) -> Draw:
    low, high = (math.radians(limits.get(names[0], limits.get(names[1], end)))
                 for names, end in ((("ge", "gt"), -360.0), (("le", "lt"), 360.0)))
    return lambda rng: rng.uniform(low + 0.02 * (high - low), high - 0.02 * (high - low))


def color(group: Rng, limits: Limits) -> Draw:
    """Draw a colour, (3,), never black, often with one channel 0. Colours without an upper limit are sometimes as bright as allowed."""
    most = min(limits.get("le", 3.0), 3.0)

    def draw(rng: Rng) -> np.ndarray:
        out = most * rng.uniform(0.05, 1.0, 3)
        if rng.random() < 0.3:
            out[rng.integers(3)] = 0.0
        return out / out.max() * LARGEST if "le" not in limits and rng.random() < 0.04 else out

    return draw


def image(group: Rng, limits: Limits) -> Draw:
    """Draw an image, (H, W, 3) float32: mostly dark or black, one pixel bright, sometimes so bright that sums overflow."""

    def draw(rng: Rng) -> np.ndarray:
        out = 2.0 * rng.random((rng.integers(1, 8), rng.integers(1, 12), 3)) ** 4
        out[rng.random(out.shape[:2]) < 0.2] = 0.0
        out[rng.integers(len(out)), rng.integers(out.shape[1])] = 3e38 if rng.random() < 0.1 else 3.0
        return out.astype(np.float32)

    return draw


def picture(rng: Rng) -> Texture:
    """Draw a texture of few pixels, alpha mostly 0 or 255, with a random affine map of uv, sometimes beyond float32's precision."""
    pixels = rng.integers(0, 256, (*rng.integers(1, 9, 2), 4), dtype=np.uint8)
    ends = rng.random(pixels.shape[:2]) < 0.6
    pixels[ends, 3] = rng.choice([0, 255], ends.sum())
    matrix = rng.normal(0.0, 2.0, (2, 3)) * (10.0 ** rng.uniform(3.0, 15.0) if rng.random() < 0.1 else 1.0)
    return Texture(pixels, bool(rng.random() < 0.5), tuple(rng.choice(WRAPS, 2)), matrix)


def texture(group: Rng, limits: Limits) -> Draw:
    kind = limits["among"][group.integers(len(limits["among"]))]
    return picture if kind is Texture else sketch(group, kind)


def fixed(value: Any) -> Draw:
    return lambda rng: value


# For each form in wrt.scene.values.FORMS, a function of the group's generator and the field's limits. None: random_scenes draws it.
DRAWS: dict[str, Callable[[Rng, Limits], Draw] | None] = {
    "point": lambda group, limits: lambda rng: rng.uniform(-4.0, 4.0, 3),
    "direction": lambda group, limits: lambda rng: rng.normal(size=3),
    "color": color,
    "number": number,
    "angle": angle,
    "whole": lambda group, limits: fixed(int(group.integers(limits["ge"], limits["le"] + 1))),
    "flag": lambda group, limits: fixed(bool(group.random() < 0.5)),
    "choice": lambda group, limits: fixed(str(group.choice(limits["among"]))),
    "size": None,
    "image": image,
    "texture": texture,
}


def sketch(group: Rng, kind: Any, odds: Mapping[str, float] = {}, /, **given: Any) -> Draw:
    """Return a Draw of `kind` with random fields. odds: probability that a field differs from its default, by name, else 0.5."""
    for _ in range(TRIES):
        draws: dict[str, Draw] = {}
        for name, each in forms(kind).items():
            draw, needed = DRAWS[each.metadata["form"]], each.default is MISSING and each.default_factory is MISSING
            if draw is not None and (needed or group.random() < odds.get(name, 0.5)) and name not in given:
                draws[name] = draw(group, each.metadata["limits"])

        def make(rng: Rng, draws: dict[str, Draw] = draws) -> Any:
            for _ in range(TRIES):
                try:
                    return kind(**given, **{name: draw(rng) for name, draw in draws.items()})
                except InputError as error:  # these values do not go together
                    refused = error
            raise refused

        try:
            make(np.random.default_rng(0))
        except InputError:  # no values go with the group's choices
            continue
        return make
    raise AssertionError(f"no {kind.__name__} can be drawn")
