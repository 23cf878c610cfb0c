"""Run the C++ headers of kernels/ under AddressSanitizer and UndefinedBehaviorSanitizer: `python -m tests.sanitize`.

g++ and clang++, if installed, compile each program of PROGRAMS with the headers, without Warp. The program reads cases that Python
wrote, runs the headers' functions on arrays of exact length, and compares the results with those of the scalar kernels. A further
program is one more row: its source in this folder, its layout.h, and a function that writes its cases.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tests.data import ROOT
from tests.sanitize import shading
from tests.sanitize.cases import write_cases
from wrt.kernels.loops import state
from wrt.kernels.wide.layout import LAYOUT_H

HERE = Path(__file__).parent
COMPILERS = "g++", "clang++"
# -Wno-psabi: a program is one file, so the ABI of vector arguments does not matter.
PLAIN = "-std=c++17", "-ffp-contract=off", "-DWRT_CHECK", "-Wall", "-Wextra", "-Wno-psabi"
SANITIZED = "-O1", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"

LIMIT = 120  # seconds for a program: a broken traversal may never end


class Program(NamedTuple):
    """A C++ program. headers: the folder of kernels/ with its headers; layout: the text of the generated layout.h."""

    source: str
    headers: str
    layout: str
    write_cases: Callable[[Path], None]


PROGRAMS = (
    Program("walks.cpp", "wide", LAYOUT_H, write_cases),
    Program("shading.cpp", "shade", state.LAYOUT_H, shading.write_cases),
)


def compile_program(compiler: str, program: Program, folder: Path, *flags: str) -> Path:
    """Write layout.h and compile the program into a folder; return its path. Raises CalledProcessError."""
    (folder / "layout.h").write_text("#pragma once\n" + program.layout)
    out = folder / f"{program.source}-{compiler}"
    where = "-I", str(ROOT / "kernels" / program.headers), "-I", str(folder)
    subprocess.run([compiler, *PLAIN, *flags, *where, str(HERE / program.source), "-o", str(out)], check=True)
    return out


def usable() -> list[str]:
    """Return the compilers that are installed and can link the libraries of the sanitizers."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "empty.cpp"
        source.write_text("int main() { return 0; }\n")
        command = [*SANITIZED, str(source), "-o", str(Path(folder) / "empty")]
        return [name for name in COMPILERS if shutil.which(name)
                and subprocess.run([name, *command], capture_output=True, check=False).returncode == 0]


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.sanitize", description=__doc__)
    parser.add_argument("--if-possible", action="store_true", help="exit with 0 instead of 2 if no compiler has the sanitizers")
    options = parser.parse_args(arguments)
    compilers = usable()
    if not compilers:
        print("not run: needs g++ or clang++ with the libraries of -fsanitize=address,undefined")
        return 0 if options.if_possible else 2
    worst = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for program in PROGRAMS:
            program.write_cases(folder / "cases")
            for compiler in compilers:
                print(f"{program.source}, {compiler}: ", end="", flush=True)
                runs = compile_program(compiler, program, folder, *SANITIZED)
                result = subprocess.run([str(runs), str(folder / "cases")], check=False, timeout=LIMIT)
                worst = max(worst, abs(result.returncode))
    return 1 if worst else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
