"""C++ in `.h` files beside the kernels: each is the body of one native function, or a part of several.
Python defines the constants of a layout, and `source` passes them to C++ by name. `#include "part.h"` stands for that file's text, and a
macro ends with its function. Warp hashes the whole text, so that a changed file is compiled again."""

import re
from pathlib import Path

INCLUDE = re.compile(r'^ *#include "(\w+\.h)"$', re.MULTILINE)
WORD = re.compile(r"\w+")
MACRO = re.compile(r"^ *#define (\w+)", re.MULTILINE)


def text_of(file: Path) -> str:
    """Return the text of a file, with its includes from its own folder."""
    return INCLUDE.sub(lambda line: text_of(file.parent / line[1]), file.read_text())


def literal(value: float | str) -> str:
    """Write a value as C++; a str is C++ already."""
    if isinstance(value, float):
        return f"({value.hex()}f)"
    return value if isinstance(value, str) else f"({int(value)})"


def source(file: str | Path, **constants: float | str) -> str:
    """Return the body of a native function, for wp.func_native: a file with the constants that it names. The file is "wide/gather.h" of
    this folder, or a path; a constant is int, float, bool, or C++ as str."""
    body = text_of(Path(__file__).parent / file)
    words = set(WORD.findall(body))
    named = [name for name in constants if name in words]
    before = "".join(f"#define {name} {literal(constants[name])}\n" for name in named)
    after = "".join(f"#undef {name}\n" for name in dict.fromkeys([*named, *MACRO.findall(body)]))
    return f"\n{before}{body}{after}"
