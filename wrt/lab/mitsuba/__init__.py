"""Comparison with Mitsuba 3: translate a scene, render it, compare time and error."""

from collections.abc import Sequence
from dataclasses import dataclass

from wrt.lab import Plan, option

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
INTEGRATORS = ("auto", "path", "direct", "volpath")


@dataclass(frozen=True)
class Mitsuba(Plan):
    """Options of a comparison with Mitsuba 3 at equal error."""

    QUICK = {"spp": 8, "repeats": 3, "rival_limit": 5.0, "starts": 1}
    spp: int = option(64, "Samples per pixel of wrt; Mitsuba takes as many as it needs for the same error", (1, 1 << 16))
    repeats: int = option(7, "Pictures of each renderer, alternating, each with its own seed", (3, 1000))
    reference_spp: int | None = option(None, "Samples per pixel of 8 reference pictures each  [default: 8 times --spp]", (1, 1 << 24))
    rival_limit: float = option(60.0, "Longest time for a picture by Mitsuba  [default: 60s]")
    integrator: str = option("auto", "Integrator of Mitsuba: auto, path, volpath or direct", of=("integrator", f"{__name__}:INTEGRATORS"))
    variants: Sequence[str] = option(VARIANTS, "Variants of Mitsuba; llvm_ad_rgb needs an LLVM library",
                                     of=("variant of Mitsuba", f"{__name__}:VARIANTS"))
    starts: int = option(3, "Number of timed runs of whole processes; 0 skips them", (0, 1000))
    seed: int = option(0, "Seed from which the seeds of all pictures follow")
