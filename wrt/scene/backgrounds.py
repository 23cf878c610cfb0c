"""What rays see that hit nothing: one class a kind, and a row in BACKGROUNDS."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrt.scene.kinds import Kind, forms, given
from wrt.scene.values import BLACK, LUMINANCE, WHITE, Color


class Background(Kind):
    """What every kind of background is; its device functions stand in kernels/shade/backgrounds.py, under the same name.

    An array in `record` becomes one on the device.
    """

    what = "background"
    name = ""

    @property
    def is_black(self) -> bool:
        """Whether it lights nothing: all its colours, if it has some, are black. Then it is not sampled."""
        colors = [getattr(self, name) for name, each in forms(type(self)).items() if each.metadata["form"] == "color"]
        return bool(colors) and not np.any(colors)


@dataclass(frozen=True)
class ConstantBackground(Background):
    """The same radiance from everywhere."""

    kind = "constant"
    color: Color = field(default=BLACK, metadata=given("color", "from every direction", "radiance"))

    def record(self) -> dict[str, Any]:
        return {"bottom": self.color, "top": self.color}


@dataclass(frozen=True)
class GradientBackground(Background):
    """Linear in the direction's y."""

    kind = "gradient"
    bottom: Color = field(default=WHITE, metadata=given("color", "from straight below (-y)", "radiance"))
    top: Color = field(default=(0.5, 0.7, 1.0), metadata=given("color", "from straight above (+y)", "radiance"))

    def record(self) -> dict[str, Any]:
        return {"bottom": self.bottom, "top": self.top}


@dataclass(frozen=True, eq=False)
class EnvironmentBackground(Background):
    """An equirectangular picture: its middle column is seen along -z, its upper edge is +y.

    Row 0 of `image` is the upper edge, and columns run to the right of the view along -z (towards +x).
    """

    kind = "environment"
    what = "environment"
    image: np.ndarray = field(repr=False, metadata=given("image", "image (.exr, .hdr, or sRGB), relative to the scene file"))
    scale: float = field(default=1.0, metadata=given("number", "multiplies the image", ge=0.0))
    rotation: float = field(default=0.0, metadata=given("angle", "about +y, counter-clockwise seen from above"))
    name: str = ""

    def record(self) -> dict[str, Any]:
        """With tables that choose a pixel by its brightness times its solid angle."""
        # Bilinear look-up spreads a pixel into its neighbours: their chance must not be 0. A small share of the mean keeps
        # dark places in reach of light that rounding leaves there.
        height, width = self.image.shape[:2]
        brightness = self.image.astype(np.float64) @ LUMINANCE
        spread = np.maximum(np.maximum(brightness, np.roll(brightness, 1, axis=1)), np.roll(brightness, -1, axis=1))
        spread = np.maximum(spread, np.maximum(np.vstack([spread[:1], spread[:-1]]), np.vstack([spread[1:], spread[-1:]])))
        weight = (spread + 1e-3 * spread.mean() + 1e-30) * np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None]
        row = np.cumsum(weight.sum(axis=1))
        column = np.cumsum(weight, axis=1)
        return {"width": width, "height": height, "scale": self.scale, "rotation": self.rotation,
                "pixels": self.image.reshape(-1, 3), "row_cdf": row / row[-1], "column_cdf": (column / column[:, -1:]).ravel()}


BACKGROUNDS: dict[str, type[Background]] = {
    each.kind: each for each in (ConstantBackground, GradientBackground, EnvironmentBackground)}
