"""Each C++ header of kernels/ compiles alone and without Warp, and gives the results of the scalar kernels."""

import shutil
import subprocess

import pytest

from tests.data import ROOT
from tests.sanitize.__main__ import COMPILERS, PLAIN, PROGRAMS, compile_program

INSTALLED = [name for name in COMPILERS if shutil.which(name)]
HEADERS = [(program, path) for program in PROGRAMS for path in sorted((ROOT / "kernels" / program.headers).glob("*.h"))]
needs_a_compiler = pytest.mark.skipif(not INSTALLED, reason="needs g++ or clang++")


@needs_a_compiler
@pytest.mark.parametrize("compiler", INSTALLED)
@pytest.mark.parametrize(("program", "header"), HEADERS, ids=lambda value: getattr(value, "name", None))
def test_a_header_compiles_by_itself(program, header, compiler, tmp_path):
    (tmp_path / "layout.h").write_text("#pragma once\n" + program.layout)
    (tmp_path / "alone.cpp").write_text(f'#include "{header.name}"\n')
    command = [compiler, *PLAIN, "-Werror", "-Wno-unused-function", "-fsyntax-only", "-I", str(header.parent), "-I", str(tmp_path)]
    subprocess.run([*command, str(tmp_path / "alone.cpp")], check=True)


@needs_a_compiler
@pytest.mark.parametrize("program", PROGRAMS, ids=lambda program: program.source)
def test_the_headers_give_the_results_of_the_scalar_kernels(program, tmp_path):
    program.write_cases(tmp_path / "cases")
    runs = compile_program(INSTALLED[0], program, tmp_path, "-O0", "-Werror")
    subprocess.run([str(runs), str(tmp_path / "cases")], check=True)
