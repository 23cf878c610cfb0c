"""CUDA binaries: the reader finds what was compiled, and refuses other files."""

from __future__ import annotations

from pathlib import Path

import warp as wp

from tests.refused import refused
from wrt.lab.rtcore.cubin import read_cubin


@wp.kernel(module="unique", enable_backward=False)
def plain(x: wp.array(dtype=wp.float32)):  # type: ignore[valid-type]
    x[wp.tid()] = 2.0 * x[wp.tid()]


@wp.kernel(module="unique", enable_backward=False)
def with_a_stack(x: wp.array(dtype=wp.float32), order: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
    row = wp.zeros(shape=64, dtype=wp.float32)
    for i in range(order.shape[0]):
        row[order[i]] += x[i]
    x[wp.tid()] = row[order[wp.tid()]]


def compiled(kernel: object, folder: Path) -> bytes:
    (binary,) = wp.compile_aot_module(kernel.module, arch=75, module_dir=folder)  # type: ignore[attr-defined]
    return Path(binary).read_bytes()


def test_the_code_of_a_kernel_is_found(tmp_path: Path) -> None:
    small, large = (list(read_cubin(compiled(kernel, tmp_path / kernel.key)).values()) for kernel in (plain, with_a_stack))
    assert len(small) == len(large) == 1
    assert small[0].name.startswith("plain") and len(small[0].code) % 16 == 0 and small[0].code
    assert small[0].stack == 0 and large[0].stack >= 256  # 64 floats
    assert 0 < small[0].registers < 64


def test_what_is_no_binary_is_refused(tmp_path: Path) -> None:
    good = compiled(plain, tmp_path)
    for bad in (b"", b"\x7fELF\x02", b"nonsense" * 100, good[:len(good) // 2], b"\x7fELF\x01" + good[5:]):
        with refused(what="no readable CUDA binary"):
            read_cubin(bad)
