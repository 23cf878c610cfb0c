"""Compile the CUDA C++ that Warp writes for a module to an object file for the host, with Warp's Clang.

NVIDIA's compilers play no part. Warp's headers are compiled (and precompiled) as for the CPU, with the CPU's flags; the module's code
behind them as CUDA code, with `__CUDA_ARCH__` defined.
"""

from __future__ import annotations

import tempfile
from functools import cache
from hashlib import sha256
from pathlib import Path

from tests.virtual_gpu.warp_private import BLOCK_DIM, KERNEL, LAST_HEADER, compile_for_host

DEVICE_H = Path(__file__).with_name("device.h").read_text()
LEVEL = 2  # optimisation, the same as for the CPU
SUFFIX = f".virtual{sha256(DEVICE_H.encode()).hexdigest()[:8]}.cubin"


def entry(kernel: str) -> str:
    """Return the name of the function that runs a whole grid of a kernel."""
    return f"virtual_gpu_{kernel}"


def for_host(source: str, arch: int) -> str:
    """Return the C++ for the host of a module in CUDA C++."""
    block_dim = BLOCK_DIM.search(source)
    if block_dim is None or source.count(LAST_HEADER) != 1:
        raise NotImplementedError("the CUDA module does not begin with the headers that Warp 1.19 writes")
    headers, text = source.split(LAST_HEADER)
    headers = BLOCK_DIM.sub("#define WP_TILE_BLOCK_DIM 1", headers)  # as precompiled for the CPU
    device = DEVICE_H.replace("MODULE_BLOCK_DIM", block_dim[1]).replace("MODULE_ARCH", f"{arch}0")
    entries = [f'extern "C" void {entry(name)}(void** arguments, const virtual_gpu::Grid* grid)'
               f" {{ virtual_gpu::run({name}, arguments, *grid); }}\n" for name in KERNEL.findall(text)]
    return "".join((headers, LAST_HEADER, device, text, *entries))


@cache
def precompiled_headers() -> tempfile.TemporaryDirectory[str]:
    """Return the folder for Clang's precompiled headers, which is removed at the end of the process."""
    return tempfile.TemporaryDirectory()


def compile_module(source: str, arch: int, path: str, *, fuse_fp: bool) -> int:
    """Write the object file; return 0, or an error code of Clang, which prints the error on stderr."""
    return compile_for_host(for_host(source, arch), Path(path).with_suffix(".cpp").name, path, precompiled_headers().name,
                            fuse_fp=fuse_fp, level=LEVEL)
