"""How a picture is taken: size, samples, bounces, filter, tone mapping."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from wrt.scene.kinds import check_fields, given

FILTERS = ("box", "gaussian", "blackman-harris")
SAMPLERS = ("sobol", "independent")
TONEMAPS = ("none", "reinhard", "aces", "agx")
MAX_DEPTH = 64  # bounces
DEPTH, GLASS_DEPTH = 8, 64  # bounces where nobody gives a depth: eight leave a black band in the rim of a glass vase
FRESNELS = ("exact", "schlick")
GLASS_SHADOWS = ("opaque", "tinted")


@dataclass(frozen=True)
class Settings:
    """How a scene wants to be rendered; every field can be overridden at the call of `render`.

    max_depth: bounces after the first hit (0: only direct light). None, the default, is for the Scene to choose: GLASS_DEPTH
    where light goes through one of its materials, else DEPTH. min_throughput: a ray that would carry less than this
    share (largest channel) is cut. fresnel: "exact", or "schlick" (cheaper, approximate). glass_shadows: solid glass
    "opaque" to shadow rays (right but for caustics, which a Whitted tracer does not see), or "tinted": shadow rays go
    straight through it, as they do in scenes from glTF files that have solid glass. sampler: "sobol" (Owen-scrambled, evenly
    spread), or "independent" random numbers, whose noise falls more slowly. exposure in stops.
    """

    size: tuple[int, int] = field(default=(640, 360), metadata=given("size", "width and height", "pixels"))
    spp: int = field(default=64, metadata=given("whole", "samples per pixel", ge=1, le=1 << 24))
    max_depth: int = field(default=None, metadata=given(  # type: ignore[assignment]  # a Scene's is a number
        "whole", f"bounces after the first hit (default: {GLASS_DEPTH} where light goes through a material, else {DEPTH})", ge=0,
        le=MAX_DEPTH))
    min_throughput: float = field(default=1e-3, metadata=given("number", "a ray that carries less is cut", ge=0.0, le=1.0))
    filter: str = field(default="blackman-harris", metadata=given("choice", "pixel filter", among=FILTERS))
    fresnel: str = field(default="exact", metadata=given("choice", "of dielectrics", among=FRESNELS))
    glass_shadows: str = field(default="opaque", metadata=given(
        "choice", "tinted: shadow rays go straight through solid glass (default: tinted where an included glTF file has solid"
        " glass, else opaque)", among=GLASS_SHADOWS))
    sampler: str = field(default="sobol", metadata=given(
        "choice", "how a pixel's samples are spread: evenly, or by independent random numbers", among=SAMPLERS))
    exposure: float = field(default=0.0, metadata=given("number", "doubles what is shown with each", "stops", ge=-100.0, le=100.0))
    tonemap: str = field(default="none", metadata=given("choice", "curve from linear to display", among=TONEMAPS))

    def __post_init__(self) -> None:
        check_fields(self, "")


SETTINGS = tuple(each.name for each in fields(Settings))
