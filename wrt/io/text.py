"""Numbers and comments of text files of meshes, as the programs that write these files spell them."""

import math
import re

from wrt.core.checks import short
from wrt.core.errors import InputError

# Not a number and infinity, as C libraries print them: nan(ind), nan(0x8000), NaNQ; 1.#IND, 1.#QNAN0, 1.#INF00e+000, or rounded 1.#J.
_NOT_FINITE = re.compile(r"([+-]?)(?:nan[qs]|nan\(\w*\)|\d\.#(?:(inf)|[ijqrs])\w*(?:[+-]\d+)?)", re.IGNORECASE)
# The # of 1.#IND begins no comment.
_COMMENT = re.compile(r"#(?!(?<=\d\.#)[ijqrs]).*", re.IGNORECASE | re.DOTALL)


def as_number(word: str | bytes) -> float:
    """Return the number that a word stands for. It may have an exponent of Fortran, 1.0D+00. Raises InputError for other words."""
    text = word if isinstance(word, str) else word.decode("latin-1")
    found = _NOT_FINITE.fullmatch(text)
    if found:
        return math.copysign(math.inf if found[2] else math.nan, -1.0 if found[1] == "-" else 1.0)
    try:
        return float(text.lower().replace("d", "e"))
    except ValueError:
        hint = "numbers need a decimal point, not a comma" if "," in text else None
        raise InputError(f"{short(text)} is not a number", hint=hint) from None


def without_comment(line: str) -> str:
    """Return a line of numbers without the comment that begins with #."""
    return _COMMENT.sub(" ", line) if "#" in line else line
