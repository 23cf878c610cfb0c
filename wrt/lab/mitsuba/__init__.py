"""Comparison with Mitsuba 3: translate a scene, render it, compare time and error."""

from collections.abc import Sequence
from dataclasses import dataclass

from wrt.lab import OnScene, option, the_seed

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
INTEGRATORS = ("auto", "path", "direct", "volpath")


@dataclass(frozen=True)
class Mitsuba(OnScene):
    """Render SCENE with wrt and with Mitsuba 3. Use scalar_rgb and llvm_ad_rgb, and all threads. Compare the times to equal error,
    with and without the start of the process.

    llvm_ad_rgb needs an LLVM library (19 works), named in the environment variable DRJIT_LIBLLVM_PATH."""

    COMMAND, STUDY = "bench mitsuba", "wrt.lab.mitsuba.equal_error"
    QUICK = {"spp": 8, "repeats": 3, "rival_limit": 5.0, "starts": 1}
    size: str = option("320x180", "Width x height of the picture, in pixels", check="wrt.core.checks:as_size")
    spp: int = option(64, "Samples per pixel of wrt; Mitsuba takes as many as it needs for the same error", (1, 1 << 16))
    repeats: int = option(7, "Pictures of each renderer, alternating, each with its own seed", (3, 1000))
    reference_spp: int | None = option(None, "Samples per pixel of 8 reference pictures each  [default: 8 times --spp]", (1, 1 << 24))
    rival_limit: float = option(60.0, "Longest time for a picture by Mitsuba  [default: 60s]")
    matte: bool = option(False, "Make every surface diffuse, so that Mitsuba's integrator direct computes the same light")
    integrator: str = option("auto", "Integrator of Mitsuba: auto (direct with --matte), path, volpath or direct",
                             of=("integrator", f"{__name__}:INTEGRATORS"))
    variants: Sequence[str] = option(VARIANTS, "Variants of Mitsuba; llvm_ad_rgb needs an LLVM library",
                                     of=("variant of Mitsuba", f"{__name__}:VARIANTS"))
    starts: int = option(3, "Number of timed runs of whole processes; 0 skips them", (0, 1000))
    seed: int = the_seed()
