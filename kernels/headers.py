"""C++ headers beside the kernels: functions in namespace `wrt`. Editors, g++ and Clang can parse each header alone.
wp.ModuleBuildOptions puts the text of headers before the CPU code of a Warp module. Warp hashes the text, so a changed header recompiles
the module. A native function (wp.func_native) then consists of one call. Constants shared with Python are in `layout.h`, which is not a
file: `constants` writes its text."""

import re
from collections.abc import Mapping
from pathlib import Path

import warp as wp

FOLDER = Path(__file__).parent
# Vectors of this length are traversal stacks, of a length that no other vector has. In kernels of wrt their constructor without arguments
# sets no entry: Warp's would write 512 bytes for each ray.
STACK_LENGTH = 67
STACKS = "".join(f"template <> inline CUDA_CALLABLE wp::vec_t<{STACK_LENGTH}, wp::{kind}>::vec_t() {{}}\n" for kind in ("uint64", "int32"))
LINE = re.compile(r'#include "(\w+\.h)"|#pragma once')


def constants(numbers: Mapping[str, float], struct: str = "") -> str:
    """Return the C++ definitions of constants in namespace wrt; if `struct` is set, as static members of a struct of that name."""
    kinds = {name: "float" if isinstance(value, float) else "unsigned" if value >= 2**31 else "int"
             for name, value in numbers.items()}
    lines = [f"constexpr {kinds[name]} {name} = " + (f"{value.hex()}f;" if isinstance(value, float) else f"{int(value)};")
             for name, value in numbers.items()]
    body = "struct " + struct + " {\n" + "".join(f"static {line}\n" for line in lines) + "};" if struct else "\n".join(lines)
    return f"namespace wrt {{\n{body}\n}}\n"


def text_of(*files: str, **written: str) -> str:
    """Return the text of headers. Each is included once, and after the headers that it includes. Paths in `files`, such as "wide/packet.h",
    are below this folder. Argument `written` has the texts of headers that are not files, by stem ("layout" for layout.h)."""
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
            out.append(f'#line {number + 1} "{path.relative_to(FOLDER.parent)}"\n')  # compiler messages name the header and its line


def with_headers(*files: str, **written: str) -> wp.ModuleBuildOptions:
    """Return STACKS and the headers as the Warp module option "extra_build_options"; the headers apply to CPU code only."""
    return wp.ModuleBuildOptions(extra_cpu_preamble=STACKS + text_of(*files, **written), extra_cuda_preamble=STACKS)
