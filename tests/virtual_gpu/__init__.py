"""Virtual GPUs: what wrt does on CUDA devices runs on a machine without one.

Warp writes CUDA C++ for every kernel, as ever; Warp's own Clang compiles it for the host, blocks and threads are walked in a loop,
and Warp's Python finds `cuda:0`, `cuda:1` ... So the host code for CUDA and the CUDA branches of device code run as they are.

    python -m pytest --device cuda:0 tests/kernels          tests on a virtual GPU
    python -m tests.virtual_gpu render scenes/lens.toml --device cuda:0

It finds: a kernel that gets an array of another device, of the host (or on the CPU, of a device) or a freed one: VirtualGpuError
names the argument; other host code that reads device memory (a segmentation fault: pages are closed while no kernel runs); kernels
that leave their arrays (likewise) or read what nobody wrote (0xA5); what depends on the order of threads (it is random, by a seed);
CUDA branches that do not compile, or say something else; the signs of zeros by fminf and fmaxf. It counts
launches, copies and synchronisations.

It does not find: what NVIDIA's compilers and driver do; speed; a wait that lacks (each call is done when it returns); races (threads run
one after another). A graph repeats the calls that its capture recorded; a call that cannot be captured is an error. Of Warp's own CUDA
code only a sort is there (no Mesh, no Bvh). A kernel's sin, pow, exp and the like are the host's, not NVIDIA's, whose last bits differ;
wrt's kernels have their own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import warp as wp

from tests.virtual_gpu import warp_private
from tests.virtual_gpu.compiler import SUFFIX
from tests.virtual_gpu.driver import NAME, Core, Gpus
from tests.virtual_gpu.graphs import VirtualGpuError

__all__ = ["NAME", "VirtualGpuError", "gpus", "install"]


def install(devices: int = 2, arch: int = 75, seed: int | None = 0, memory: int = 8 << 30) -> None:
    """Let Warp find virtual GPUs; before wp.init(). The arguments are those of Gpus."""
    if warp_private.has_started():
        raise RuntimeError("virtual GPUs are installed before Warp starts")
    if not wp.config.version.startswith(warp_private.VERSION):
        raise NotImplementedError(f"virtual GPUs know the insides of Warp 1.19, not of {wp.config.version}")

    def library_of(library: Any, path: str) -> Any:
        return library if "clang" in Path(path).name else Core(library, Gpus(library, devices, arch, seed, memory))

    def name_of(name: str, device: Any) -> str:
        """Nothing takes a file of ours for NVIDIA's; without a device it is NVIDIA's that is asked for."""
        return str(Path(name).with_suffix(SUFFIX)) if device and device.is_cuda else name

    def loaded(handle: int, arguments: list[tuple[str, Any]], dimensions: int) -> None:
        function = gpus().objects[handle]
        function.arguments, function.dimensions = arguments, dimensions

    warp_private.replace(library_of, name_of, loaded, lambda kernel, given: gpus().check_arguments(kernel, given, None))


def gpus() -> Gpus:
    """Those of this process, after wp.init()."""
    return warp_private.library().gpus  # type: ignore[no-any-return]
