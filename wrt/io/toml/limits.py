"""What a TOML text asks of a parser, looked at before it is parsed: of some texts, tomllib's time and memory grow with the square
of their length, or are hundreds of times that."""

from __future__ import annotations

import re
from typing import NamedTuple

from wrt.core.errors import InputError

MAX_PARTS = 16  # of a dotted key; scenes need five. tomllib keeps a copy of every beginning of a key.
MAX_WORD = 4096  # characters of a name without quotes, or of a number
# Of memory, at most, measured on files that repeat one thing: a character; a bracket; a key with a plain value; a part of a key
# that tomllib keeps flags of (dotted, a header, or with an array or a table as its value).
BYTES_OF_CHARACTER, BYTES_OF_BRACKET, BYTES_OF_KEY, BYTES_OF_PART = 16.0, 100.0, 250.0, 1200.0

# Quantifiers with a second + never go back, so that the time is that of one walk through the text. A string without an end goes to
# the end of its line, or of the text: tomllib stops there.
_STRING = r'"[^"\\\n]*+(?:\\.[^"\\\n]*+)*+"?|' r"'[^'\n]*+'?"
_PART = rf"(?:[A-Za-z0-9_+:-]++|{_STRING})"
_TOKEN = re.compile(
    r'"""[^"\\]*+(?:(?:\\.|"(?!""))[^"\\]*+)*+(?:"{3,5}|\Z)|'
    r"'''[^']*+(?:'(?!'')[^']*+)*+(?:'{3,5}|\Z)|"
    r"#[^\n]*+|"
    rf"(?P<header>^[ \t]*+\[++[ \t]*+)?(?P<key>{_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)(?P<value>[ \t]*+=[ \t]*+[\[{{]?)?",
    re.MULTILINE | re.DOTALL,
)
_PARTS = re.compile(_PART)


class Asked(NamedTuple):
    """Counts of what takes memory in a text."""

    characters: int
    brackets: int
    keys: int
    parts: int

    @property
    def bytes(self) -> float:
        """Memory that tomllib takes at most."""
        return (BYTES_OF_CHARACTER * self.characters + BYTES_OF_BRACKET * self.brackets + BYTES_OF_KEY * self.keys
                + BYTES_OF_PART * self.parts)


def look_at(text: str) -> Asked:
    """Count, in one walk through the text. Raises InputError, with the line, for a key of more than MAX_PARTS parts and for a
    name or number of more than MAX_WORD characters."""
    keys = parts = 0
    for token in _TOKEN.finditer(text):
        key = token["key"]
        if key is None:
            continue
        if len(key) > 2 * MAX_PARTS or token["value"] or token["header"]:
            count = _count_parts(key, text, token.start("key"))
            if token["header"] or count > 1 or (token["value"] or "")[-1:] in ("[", "{"):
                parts += count
            elif token["value"]:
                keys += 1
    return Asked(len(text), text.count("[") + text.count("{"), keys, parts)


def _count_parts(key: str, text: str, begin: int) -> int:
    """How many parts a key has, or another word (a number, a string)."""
    count = 0
    for part in _PARTS.finditer(key):
        count += 1
        if count > MAX_PARTS:
            _fail(f"a key of more than {MAX_PARTS} parts", text, begin)
        if part.end() - part.start() > MAX_WORD and key[part.start()] not in "\"'":
            kind = "number" if key[part.start()] in "+-0123456789" else "name without quotes"
            _fail(f"a {kind} of more than {MAX_WORD} characters", text, begin)
    return count


def _fail(what: str, text: str, at: int) -> None:
    line = text.count("\n", 0, at) + 1
    raise InputError(what, None, f"line {line}, column {at - text.rfind(chr(10), 0, at)}")
