"""From the CUDA C++ that Warp writes for a module to an object file of the host, by Warp's own Clang.

No code of NVIDIA's compilers is made or read. Warp's headers are taken in their form for the CPU (the precompiled ones, with the
CPU's flags); the module's text after them as CUDA code, with `__CUDA_ARCH__` defined.
"""

from __future__ import annotations

import tempfile
from functools import cache
from hashlib import sha256
from pathlib import Path

from tests.virtual_gpu.warp_private import BLOCK_DIM, KERNEL, LAST_HEADER, compile_for_host

DEVICE_H = Path(__file__).with_name("device.h").read_text()
LEVEL = 2  # of optimisation, as for the CPU
SUFFIX = f".virtual{sha256(DEVICE_H.encode()).hexdigest()[:8]}.cubin"


def entry(kernel: str) -> str:
    """The name of the function that runs a whole grid of a kernel."""
    return f"virtual_gpu_{kernel}"


def for_host(source: str, arch: int) -> str:
    """The C++ of a module for the host."""
    block_dim = BLOCK_DIM.search(source)
    if block_dim is None or source.count(LAST_HEADER) != 1:
        raise NotImplementedError("Warp writes another beginning of CUDA modules than its release 1.19")
    headers, text = source.split(LAST_HEADER)
    headers = BLOCK_DIM.sub("#define WP_TILE_BLOCK_DIM 1", headers)  # as precompiled for the CPU
    device = DEVICE_H.replace("MODULE_BLOCK_DIM", block_dim[1]).replace("MODULE_ARCH", f"{arch}0")
    entries = [f'extern "C" void {entry(name)}(void** arguments, const virtual_gpu::Grid* grid)'
               f" {{ virtual_gpu::run({name}, arguments, *grid); }}\n" for name in KERNEL.findall(text)]
    return "".join((headers, LAST_HEADER, device, text, *entries))


@cache
def precompiled_headers() -> tempfile.TemporaryDirectory[str]:
    """The folder for what Clang precompiles, removed at the end of the process."""
    return tempfile.TemporaryDirectory()


def compile_module(source: str, arch: int, path: str, *, fuse_fp: bool) -> int:
    """Write the object file. Zero, or an error that Clang has printed on stderr."""
    return compile_for_host(for_host(source, arch), Path(path).with_suffix(".cpp").name, path, precompiled_headers().name,
                            fuse_fp=fuse_fp, level=LEVEL)
