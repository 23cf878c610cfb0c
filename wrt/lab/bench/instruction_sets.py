"""Names of the vector instructions that a processor has, and that wrt's kernels are compiled for."""

import re

import warp as wp

from wrt.core.device import start
from wrt.core.warp_private import processor_features

# LLVM's name of a feature -> name in reports, the widest first.
WIDEST = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "sse4.2": "SSE", "sse2": "SSE", "sve": "SVE", "neon": "NEON"}
LEVELS = {"x86-64": "SSE", "x86-64-v2": "SSE", "x86-64-v3": "AVX2", "x86-64-v4": "AVX-512"}


def widest(features: frozenset[str]) -> str:
    """Return the name of the widest vector instructions among LLVM's features."""
    return next((name for feature, name in WIDEST.items() if feature in features), "unknown instructions")


def compiled_for(flags: str | None, features: frozenset[str]) -> str:
    """Return the instructions that Warp compiles for with these flags (wp.config.cpu_compiler_flags) on a processor with these features."""
    target = re.search(r"-target-cpu[ =](\S+)", flags or "")
    if target:
        return LEVELS.get(target[1], target[1])
    return widest(features) if flags is None or "-march=native" in flags.split() else "the compiler's least instructions"


def instruction_sets() -> str:
    """Return a text: what wrt's kernels are compiled for, and what the processor has."""
    start("cpu")
    features = processor_features()
    used, has = compiled_for(wp.config.cpu_compiler_flags, features), widest(features)
    return f"kernels compiled for {used}" + ("" if used == has else f" on a processor with {has}")
