"""A background: sky above, ground below."""

from dataclasses import dataclass, field

import warp as wp

from wrt.kernels import structs
from wrt.kernels.shade import backgrounds as device
from wrt.scene.backgrounds import BACKGROUNDS, Background
from wrt.scene.kinds import given
from wrt.scene.values import BLACK, WHITE, Color


@dataclass(frozen=True)
class HorizonBackground(Background):
    """Two colours with a hard edge."""

    kind = "horizon"
    ground: Color = field(default=BLACK, metadata=given("color", "from below", "radiance"))
    sky: Color = field(default=WHITE, metadata=given("color", "from above", "radiance"))

    def record(self):
        return {"bottom": self.ground, "top": self.sky}


@wp.func
def horizon(b: structs.Background, direction: wp.vec3) -> wp.vec3:
    return wp.where(direction[1] < 0.0, b.bottom, b.top)


BACKGROUNDS["horizon"] = HorizonBackground
device.BACKGROUNDS["horizon"] = device.BackgroundKind(horizon)
