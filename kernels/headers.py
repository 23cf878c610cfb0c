"""C++ headers beside the kernels: whole functions in namespace `wrt`, which an editor, g++ and Clang can read alone.
A module of Warp takes C++ for the CPU before its kernels (wp.ModuleBuildOptions), as text: Warp hashes it, so that a changed header is
compiled again. A native function (wp.func_native) is then one call. Constants shared with Python are in one more header, `layout.h`, which
Python writes (`constants`)."""

import re
from collections.abc import Mapping
from pathlib import Path

import warp as wp

from wrt.kernels.native import literal

FOLDER = Path(__file__).parent
LINE = re.compile(r'#include "(\w+\.h)"|#pragma once')


def constants(numbers: Mapping[str, float], struct: str = "") -> str:
    """Write numbers as C++ constants in namespace wrt, or as members of the struct `struct`, for templates."""
    kinds = {name: "float" if isinstance(value, float) else "unsigned" if value >= 2**31 else "int"
             for name, value in numbers.items()}
    lines = [f"constexpr {kinds[name]} {name} = {literal(value)};" for name, value in numbers.items()]
    body = "struct " + struct + " {\n" + "".join(f"static {line}\n" for line in lines) + "};" if struct else "\n".join(lines)
    return f"namespace wrt {{\n{body}\n}}\n"


def text_of(*files: str, **written: str) -> str:
    """Return the text of headers ("wide/packet.h" of this folder), each after its includes from its own folder. written: texts of headers
    that are not files ("layout" for layout.h)."""
    out: list[str] = []
    seen: set[Path] = set()
    for file in files:
        _add(FOLDER / file, written, out, seen)
    return "".join(out)


def _add(path: Path, written: Mapping[str, str], out: list[str], seen: set[Path]) -> None:
    if path in seen:
        return
    seen.add(path)
    text = written.get(path.stem) or path.read_text()
    for number, line in enumerate(text.splitlines(), 1):
        found = LINE.match(line)
        if not found:
            out.append(f"{line}\n")
        else:
            if found[1]:
                _add(path.parent / found[1], written, out, seen)
            out.append(f'#line {number + 1} "{path.relative_to(FOLDER.parent)}"\n')  # for the compiler's messages


def with_headers(*files: str, **written: str) -> wp.ModuleBuildOptions:
    """Return the headers' text as a module of Warp takes it ("extra_build_options"), for the CPU."""
    return wp.ModuleBuildOptions(extra_cpu_preamble=text_of(*files, **written))
