"""Virtual GPUs: run wrt's code for CUDA devices on a machine without a GPU.

Warp writes CUDA C++ for every kernel; Warp's Clang compiles the C++ for the host, where a loop runs all blocks and threads. Warp's
Python finds `cuda:0`, `cuda:1` ... So the host code for CUDA and the CUDA branches of device code run unchanged.

    python -m pytest --device cuda:0 tests/kernels          tests on a virtual GPU
    python -m tests.virtual_gpu render scenes/lens.toml --device cuda:0

A virtual GPU finds:

- kernels that get a freed array, or an array that is not on their device: VirtualGpuError names the argument;
- host code that reads device memory: a segmentation fault, because the pages are closed while no kernel runs;
- kernels that read beyond their arrays (a segmentation fault), or memory that was never written (its bytes are 0xA5);
- results that depend on the order of threads, which is random with a seed;
- CUDA branches that do not compile or give other results, also in the signs of zeros by fminf and fmaxf.

It counts launches, copies and synchronisations. A graph repeats the calls that its capture recorded; a call that cannot be captured
is an error. Of Warp's own CUDA code it has only the sort (no Mesh, no Bvh).

It finds no defects of NVIDIA's compilers and driver, no missing waits (each call is done when it returns) and no races (threads run
one after another). Its speed says nothing. The functions sin, pow, exp and the like are the host's, whose last bits differ from
NVIDIA's. Kernels of wrt do not use them.
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
    """Let Warp find virtual GPUs; call before wp.init(). The arguments are those of Gpus."""
    if warp_private.has_started():
        raise RuntimeError("Warp has started; install virtual GPUs before wp.init()")
    if not wp.config.version.startswith(warp_private.VERSION):
        raise NotImplementedError(f"Warp {wp.config.version} is not supported: virtual GPUs replace private functions of Warp 1.19")

    def library_of(library: Any, path: str) -> Any:
        return library if "clang" in Path(path).name else Core(library, Gpus(library, devices, arch, seed, memory))

    def name_of(name: str, device: Any) -> str:
        """Return the file name with SUFFIX for a virtual GPU, so that nothing takes the file for NVIDIA's; else the name."""
        return str(Path(name).with_suffix(SUFFIX)) if device and device.is_cuda else name

    def loaded(handle: int, arguments: list[tuple[str, Any]], dimensions: int) -> None:
        function = gpus().objects[handle]
        function.arguments, function.dimensions = arguments, dimensions

    warp_private.replace(library_of, name_of, loaded, lambda kernel, given: gpus().check_arguments(kernel, given, None))


def gpus() -> Gpus:
    """Return the virtual GPUs of this process; call after wp.init()."""
    return warp_private.library().gpus  # type: ignore[no-any-return]
