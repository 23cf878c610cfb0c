"""C++ in `.h` files beside the kernels: each is the body of one native function, or a part of several.

Python defines every number of a layout, and `source` hands it to the C++ under a name. `#include "part.h"` stands for that file's
text, and a macro ends with its function. Warp hashes the whole text, so a changed file is compiled again.
"""

import re
from pathlib import Path

INCLUDE = re.compile(r'^ *#include "(\w+\.h)"$', re.MULTILINE)
WORD = re.compile(r"\w+")
MACRO = re.compile(r"^ *#define (\w+)", re.MULTILINE)


def text_of(file: Path) -> str:
    """A file with those that it includes, from its own folder."""
    return INCLUDE.sub(lambda line: text_of(file.parent / line[1]), file.read_text())


def literal(value: float | str) -> str:
    """As C++ writes it; text is C++ already."""
    if isinstance(value, float):
        return f"({value.hex()}f)"
    return value if isinstance(value, str) else f"({int(value)})"


def source(file: str | Path, **constants: float | str) -> str:
    """The body of a native function, for wp.func_native: a file ("wide/gather.h" of this folder, or a path), with those constants
    (int, float, bool, C++) that it names."""
    body = text_of(Path(__file__).parent / file)
    words = set(WORD.findall(body))
    named = [name for name in constants if name in words]
    before = "".join(f"#define {name} {literal(constants[name])}\n" for name in named)
    after = "".join(f"#undef {name}\n" for name in dict.fromkeys([*named, *MACRO.findall(body)]))
    return f"\n{before}{body}{after}"
