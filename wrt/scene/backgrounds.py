"""Backgrounds: the radiance of rays that hit nothing. One class and one entry of BACKGROUNDS for each kind."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from wrt.scene.kinds import Kind, Record, forms, given
from wrt.scene.values import BLACK, LUMINANCE, WHITE, Color


class Background(Kind):
    """Base class of backgrounds. kernels/shade/backgrounds.py has each kind's device functions; renders upload the arrays of `record()`."""

    what = "background"
    name = ""

    @property
    def is_black(self) -> bool:
        """True if the background has colours and all of them are black. Renders do not sample a black background."""
        colors = [getattr(self, name) for name, each in forms(type(self)).items() if each.metadata["form"] == "color"]
        return bool(colors) and not np.any(colors)


@dataclass(frozen=True)
class ConstantBackground(Background):
    """The same radiance from every direction."""

    kind = "constant"
    color: Color = field(default=BLACK, metadata=given("color", "from every direction", "radiance"))

    def record(self) -> Record:
        return {"bottom": self.color, "top": self.color}


@dataclass(frozen=True)
class GradientBackground(Background):
    """Radiance that is linear in y of the ray's unit direction."""

    kind = "gradient"
    bottom: Color = field(default=WHITE, metadata=given("color", "from straight below (-y)", "radiance"))
    top: Color = field(default=(0.5, 0.7, 1.0), metadata=given("color", "from straight above (+y)", "radiance"))

    def record(self) -> Record:
        return {"bottom": self.bottom, "top": self.top}


@dataclass(frozen=True, eq=False)
class EnvironmentBackground(Background):
    """An equirectangular image: its middle column is seen along -z, its upper edge along +y.

    Parameters
    ----------
    image
        (H, W, 3) linear radiance, 0 or more. Row 0 is the upper edge. Seen along -z, columns run from left to right, towards +x.
    scale, rotation
        Factor on the radiance; rotation about +y in radians, counter-clockwise seen from above.
    """

    kind = "environment"
    what = "environment"
    image: np.ndarray = field(repr=False, metadata=given("image", "image (.exr, .hdr, or sRGB), relative to the scene file"))
    scale: float = field(default=1.0, metadata=given("number", "multiplies the image", ge=0.0))
    rotation: float = field(default=0.0, metadata=given("angle", "about +y, counter-clockwise seen from above"))
    name: str = ""

    def record(self) -> Record:
        """Return the image, the CDF of its rows and the CDFs of their columns. A pixel's weight is about brightness times solid angle."""
        # Bilinear lookup spreads a pixel into its neighbours, whose probability must therefore not be 0. A small share of the mean
        # keeps dark pixels above 0 despite rounding.
        height, width = self.image.shape[:2]
        brightness = self.image.astype(np.float64) @ LUMINANCE
        spread = np.maximum(np.maximum(brightness, np.roll(brightness, 1, axis=1)), np.roll(brightness, -1, axis=1))
        spread = np.maximum(spread, np.maximum(np.vstack([spread[:1], spread[:-1]]), np.vstack([spread[1:], spread[-1:]])))
        weight = (spread + 1e-3 * spread.mean() + 1e-30) * np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None]
        row = np.cumsum(weight.sum(axis=1))
        column = np.cumsum(weight, axis=1)
        return {"width": width, "height": height, "scale": self.scale, "rotation": self.rotation,
                "pixels": self.image.reshape(-1, 3), "row_cdf": row / row[-1], "column_cdf": (column / column[:, -1:]).ravel()}


BACKGROUNDS: dict[str, type[Background]] = {each.kind: each for each in (ConstantBackground, GradientBackground, EnvironmentBackground)}
