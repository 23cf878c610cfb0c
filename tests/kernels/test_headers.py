"""C++ headers: each is included once, and shares constants with Python."""

import re

import pytest

from tests.data import ROOT

from tests.kernel_tools import cpu_only, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels import headers
from wrt.kernels.structs import kernel


def result(size: int) -> float:
    """Return the value of a function that includes a header, which includes another header and the constants."""
    options = headers.with_headers("whole.h", layout=headers.constants({"SIZE": size, "WIDTH": 2.0**-120}))

    @wp.func_native("return wrt::twice(wrt::SIZE) + wrt::HALF + wrt::WIDTH;")
    def number() -> float: ...

    def run(out: wp.array(dtype=wp.float32)):
        out[0] = number()

    out = zeros(1)
    launch(kernel(run, extra_build_options=options), 1, out)
    return float(out.numpy()[0])


@cpu_only
def test_a_changed_header_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setattr(headers, "FOLDER", tmp_path)
    whole, part = tmp_path / "whole.h", tmp_path / "part.h"
    include = '#pragma once\n#include "layout.h"\n'
    whole.write_text(f'{include}#include "part.h"\nnamespace wrt {{ inline float twice(int a) {{ return 2 * a; }} }}\n')
    part.write_text(f"{include}namespace wrt {{ constexpr float HALF = 0.5f; }}\n")
    assert headers.text_of("whole.h", layout="// constants\n").count("// constants") == 1
    assert result(7) == 14.5
    part.write_text(f"{include}namespace wrt {{ constexpr float HALF = 0.25f; }}\n")
    assert result(7) == 14.25
    assert result(8) == 16.25


@pytest.mark.parametrize("path", sorted((ROOT / "kernels").rglob("*.h")), ids=lambda path: path.name)
def test_no_number_of_a_layout_is_typed_again(path):
    code = re.sub(r"//.*", "", path.read_text())
    assert not re.findall(r"0x[0-9a-fA-F]+p?|\b(?:48|64|72|80|127|256)\b|\d+\.\d*e\d+", code)
