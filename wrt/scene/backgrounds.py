"""What rays see that hit nothing: constant, gradient, an equirectangular picture."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from wrt.core.checks import as_array, at_thing
from wrt.core.errors import InputError
from wrt.scene.values import BLACK, WHITE, Color, as_number, as_vector


@dataclass(frozen=True)
class ConstantBackground:
    """The same radiance from every direction."""

    color: Color = BLACK

    def __post_init__(self) -> None:
        object.__setattr__(self, "color", as_vector(self.color, "background color", low=0.0))


@dataclass(frozen=True)
class GradientBackground:
    """From `bottom` (straight down, -y) to `top` (+y), linear in the direction's y."""

    bottom: Color = WHITE
    top: Color = (0.5, 0.7, 1.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bottom", as_vector(self.bottom, "background bottom", low=0.0))
        object.__setattr__(self, "top", as_vector(self.top, "background top", low=0.0))


@dataclass(frozen=True, eq=False)
class EnvironmentBackground:
    """An equirectangular picture of the surroundings.

    image: (H, W, 3) float32 linear radiance, row 0 is straight up (+y); the column at the middle is seen along -z, and
    columns run to the right of that view (towards +x). rotation: radians about +y, counter-clockwise seen from above.
    """

    image: np.ndarray = field(repr=False)
    scale: float = 1.0
    rotation: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        at = at_thing("environment", self.name)
        image = as_array(self.image, np.float32, at + "image")
        if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise InputError(at + f"image must be (H, W, 3), got {image.shape}")
        if not np.isfinite(image).all() or (image < 0.0).any():
            raise InputError(at + "image must be finite and not negative")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "scale", as_number(self.scale, at + "scale", low=0.0))
        object.__setattr__(self, "rotation", as_number(self.rotation, at + "rotation"))


Background = ConstantBackground | GradientBackground | EnvironmentBackground
