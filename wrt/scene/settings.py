"""Settings of a picture: size, samples, bounces, filter, tone mapping."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TypedDict

from wrt.scene.kinds import check_fields, given

FILTERS = ("box", "gaussian", "blackman-harris")
SAMPLERS = ("sobol", "independent")
TONEMAPS = ("none", "reinhard", "aces", "agx")
MAX_DEPTH = 64  # bounces
DEPTH, GLASS_DEPTH = 8, 64  # default bounces without and with glass: 8 leave a black band in the rim of a glass vase
FRESNELS = ("exact", "schlick")
GLASS_SHADOWS = ("opaque", "tinted")


@dataclass(frozen=True)
class Settings:
    """Render settings of a scene; each field says what it is. Keywords of `render` override them.

    `filter` is "box", "gaussian" or "blackman-harris"; `sampler` "sobol" (Owen-scrambled) or "independent", whose noise falls more slowly;
    `tonemap` "none", "reinhard", "aces" or "agx". `stats["clamped_share"]` says how much light `clamp` took. Solid glass blocks shadow
    rays, which is right except for caustics, or tints them (`glass_shadows`). `auto_exposure` is wrt.picture.tonemap.auto_exposure.
    Raises InputError if a value has the wrong type or is out of range."""

    size: tuple[int, int] = field(default=(640, 360), metadata=given("size", "width and height", "pixels"))
    spp: int = field(default=64, metadata=given("whole", "samples per pixel", ge=1, le=1 << 24))
    max_depth: int = field(default=None, metadata=given(  # type: ignore[assignment]  # a Scene's is a number
        "whole", f"bounces after the first hit (default: {GLASS_DEPTH} if light passes through a material, else {DEPTH})", ge=0,
        le=MAX_DEPTH))
    min_throughput: float = field(default=1e-3, metadata=given("number", "a ray ends below this throughput", ge=0.0, le=1.0))
    clamp: float = field(default=0.0, metadata=given(
        "number", "largest radiance of a sample, brighter ones are scaled down to it; 0: no limit", "radiance", ge=0.0, le=1e18))
    filter: str = field(default="blackman-harris", metadata=given("choice", "pixel filter", among=FILTERS))
    fresnel: str = field(default="exact", metadata=given("choice", "Fresnel term of dielectrics", among=FRESNELS))
    glass_shadows: str = field(default="opaque", metadata=given(
        "choice", "tinted: shadow rays pass straight through solid glass (default: tinted if an included glTF file"
        " has solid glass)", among=GLASS_SHADOWS))
    sampler: str = field(default="sobol", metadata=given(
        "choice", "samples of a pixel: evenly spread, or independent random numbers", among=SAMPLERS))
    exposure: float = field(default=0.0, metadata=given("number", "each stop doubles the displayed values", "stops", ge=-100.0, le=100.0))
    tonemap: str = field(default="none", metadata=given("choice", "curve from linear to display", among=TONEMAPS))
    auto_exposure: bool = field(default=False, metadata=given("flag", "add the stops that show bright parts just below white"))

    def __post_init__(self) -> None:
        check_fields(self, "")


SETTINGS = tuple(each.name for each in fields(Settings))


class SettingChanges(TypedDict, total=False):
    """The fields of Settings as keywords; None keeps the scene's value."""

    size: tuple[int, int] | str | int | None
    spp: int | None
    max_depth: int | None
    min_throughput: float | None
    clamp: float | None
    filter: str | None
    fresnel: str | None
    glass_shadows: str | None
    sampler: str | None
    exposure: float | None
    tonemap: str | None
    auto_exposure: bool | None
