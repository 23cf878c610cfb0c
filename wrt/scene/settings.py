"""How a picture is taken: size, samples, bounces, filter, tone mapping."""

from __future__ import annotations

from dataclasses import dataclass, fields

from wrt.core.checks import as_choice, as_integer, as_size
from wrt.scene.values import as_number

FILTERS = ("box", "gaussian", "blackman-harris")
SAMPLERS = ("sobol", "independent")
TONEMAPS = ("none", "reinhard", "aces", "agx")
MAX_DEPTH = 64  # bounces
FRESNELS = ("exact", "schlick")
GLASS_SHADOWS = ("opaque", "tinted")


@dataclass(frozen=True)
class Settings:
    """How a scene wants to be rendered; every field can be overridden at the call of `render`.

    max_depth: bounces after the first hit (0: only direct light). min_throughput: a ray that would carry less than this
    share (largest channel) is cut. fresnel: "exact", or "schlick" (cheaper, approximate). glass_shadows: solid glass
    "opaque" to shadow rays (right but for caustics, which a Whitted tracer does not see), or "tinted": shadow rays go
    straight through it, as they do in scenes from glTF files that have solid glass. sampler: "sobol" (Owen-scrambled, evenly
    spread), or "independent" random numbers, whose noise falls more slowly. exposure in stops.
    """

    size: tuple[int, int] = (640, 360)
    spp: int = 64
    max_depth: int = 8
    min_throughput: float = 1e-3
    filter: str = "blackman-harris"
    fresnel: str = "exact"
    glass_shadows: str = "opaque"
    sampler: str = "sobol"
    exposure: float = 0.0
    tonemap: str = "none"

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", as_size(self.size))
        object.__setattr__(self, "spp", as_integer(self.spp, "spp", 1, 1 << 24))
        object.__setattr__(self, "max_depth", as_integer(self.max_depth, "max_depth", 0, MAX_DEPTH))
        as_number(self.min_throughput, "min_throughput", low=0.0, high=1.0)
        as_number(self.exposure, "exposure", low=-100.0, high=100.0)
        as_choice(self.filter, FILTERS, "filter")
        as_choice(self.fresnel, FRESNELS, "fresnel")
        as_choice(self.glass_shadows, GLASS_SHADOWS, "glass_shadows")
        as_choice(self.sampler, SAMPLERS, "sampler")
        as_choice(self.tonemap, TONEMAPS, "tonemap")


SETTINGS = tuple(each.name for each in fields(Settings))
