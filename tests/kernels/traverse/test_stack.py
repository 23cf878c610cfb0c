"""The stack of a walk begins unset in kernels of wrt alone."""

from __future__ import annotations

import re

from tests.kernel_tools import DEVICE  # isort: skip (starts Warp)
import warp as wp

import wrt
from tests.data import ROOT
from wrt.kernels.headers import STACK_LENGTH

THREADS = 192


def test_vectors_of_a_users_kernel_begin_with_zeros() -> None:
    """Also those of the stack's length: only kernels of wrt leave a stack as the memory is."""
    def count(out: wp.array(dtype=wp.int32)) -> None:  # type: ignore[valid-type]
        i = wp.tid()
        dirty, clean = wp.vector(length=STACK_LENGTH, dtype=wp.int32), wp.vector(length=STACK_LENGTH, dtype=wp.int32)
        for j in range(STACK_LENGTH):
            out[i] = out[i] + clean[j]
            dirty[j] = i + 1
        out[i] = out[i] + dirty[0] - i - 1

    out = wp.zeros(THREADS, dtype=wp.int32, device=DEVICE)
    wp.launch(wrt.kernel(count), THREADS, [out], device=DEVICE)
    assert not out.numpy().any()


def test_no_other_vector_of_device_code_has_the_length_of_a_stack() -> None:
    vectors = re.compile(rf"(?:types\.vector|vec_t<)\W*\(?\s*{STACK_LENGTH}\b|length={STACK_LENGTH}\b")
    assert not [path for path in (ROOT / "kernels").rglob("*.[ph]*") if path.suffix in (".py", ".h") and vectors.search(path.read_text())]
