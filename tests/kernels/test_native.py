"""C++ in files: constants come from Python, parts are included, and changed files are compiled again."""

import re

import pytest

from tests.data import ROOT

from tests.kernel_tools import launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.native import source
from wrt.kernels.structs import kernel


def result(path):
    """Return the value of the C++ function in the file `path`."""

    @wp.func_native(source(path, SIZE=7, WIDTH=2.0**-120, UNUSED=True))
    def number() -> float: ...

    @kernel
    def run(out: wp.array(dtype=wp.float32)):
        out[0] = number()

    out = zeros(1)
    launch(run, 1, out)
    return float(out.numpy()[0])


def test_a_changed_file_or_part_is_compiled_again(tmp_path):
    whole, part = tmp_path / "whole.h", tmp_path / "part.h"
    whole.write_text('    #include "part.h"\n    return TWICE(SIZE) + x;\n')
    part.write_text("    #define TWICE(a) 2 * (a)\n    const float x = 0.5f;\n")
    assert result(whole) == 14.5
    part.write_text("    #define TWICE(a) 2 * (a)\n    const float x = 0.25f;\n")
    assert result(whole) == 14.25
    whole.write_text('    #include "part.h"\n    return 1.0f + x;\n')
    assert result(whole) == 1.25


def test_a_function_has_the_constants_that_it_names(tmp_path):
    path = tmp_path / "constants.h"
    path.write_text("    #define HALF 0.5f\n    return HALF * WIDTH;\n")
    assert result(path) == 2.0**-121
    text = source(path, SIZE=7, WIDTH=2.0**-120, SIZES=1)
    assert "SIZE" not in text and text.count("#undef") == 2  # No macro stays defined for the next function.


@pytest.mark.parametrize("path", sorted((ROOT / "kernels").rglob("*.h")), ids=lambda path: path.name)
def test_no_number_of_a_layout_is_typed_again(path):
    code = re.sub(r"//.*", "", path.read_text())
    assert not re.findall(r"0x[0-9a-fA-F]+p?|\b(?:48|64|72|80|127|256)\b|\d+\.\d*e\d+", code)
