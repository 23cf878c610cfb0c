"""Functions that damage files: bytes, words and lines of text, and the values of a JSON tree. Choices come from a random.Random."""

from __future__ import annotations

import copy
import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

INTEGERS = (
    0, 1, 2, 3, 4, 7, 8, 16, 63, 64, 127, 128, 255, 256, 4095, 32767, 32768, 65535, 65536, 1 << 20, (1 << 24) + 1, (1 << 31) - 1,
    1 << 31, (1 << 32) - 1, 1 << 32, (1 << 63) - 1, 1 << 63, (1 << 64) - 1, 10**12, 10**30, -1, -2, -128, -(1 << 31), -(1 << 63),
)
NUMBERS = (
    "0", "1", "-1", "2", "3", "-0.0", "0.5", "1e-30", "1e-45", "1e18", "1e30", "1e38", "3.5e38", "1e308", "1e999", "-1e999",
    "nan", "inf", "-inf", "+1", "1_000", "0x10", "0b1", "1e", ".", "1.5.2", "4294967296", "1000000000000", "9" * 30, "9" * 5000,
    "0x" + "f" * 9000, "٣", "1\u00a0", "''", "true", "1979-05-27",
)
JUNK: tuple[Any, ...] = (
    None, True, False, *INTEGERS, 0.5, -0.5, 1e-45, 1e-30, 1e18, 1e30, 3.5e38, 1e300, "", "x", "\0", "../x", "/", "/dev/zero",
    "é", "VEC3", "SCALAR", "MASK", "BLEND", "data:,", "#" * 300, [], [0], [[]], [0, 0, 0], [1.0] * 16, {}, {"index": 0},
)
MOST_BYTES = 1 << 16  # of an input: other tests check the readers' limits on larger files


def mutate(data: bytes, rng: Random, steps: Sequence[Callable[[bytearray, Random], None]], other: bytes = b"") -> bytes:
    """Return a damaged copy: apply one to eight random steps, and sometimes copy in a part of `other`."""
    out = bytearray(data)
    for _ in range(1 if rng.random() < 0.5 else rng.randint(2, 8)):
        if other and rng.random() < 0.03:
            splice(out, rng, other)
        else:
            rng.choice(steps)(out, rng)
        del out[MOST_BYTES:]
    return bytes(out)


# --- bytes ------------------------------------------------------------------------------------------------------------


def at(out: bytearray, rng: Random) -> int:
    """Return a random offset: half of the time in the first 128 bytes, the header."""
    return rng.randrange(min(len(out), 128) if rng.random() < 0.5 else len(out)) if out else 0


def flip(out: bytearray, rng: Random) -> None:
    if out:
        out[at(out, rng)] ^= 1 << rng.randrange(8)


def put_byte(out: bytearray, rng: Random) -> None:
    if out:
        out[at(out, rng)] = rng.choice((0, 1, 10, 32, 127, 128, 254, 255, rng.randrange(256)))


def put_number(out: bytearray, rng: Random) -> None:
    """Write an extreme integer or float, in a random binary format."""
    where = at(out, rng)
    kind = rng.choice("BHIQfd")
    if kind in "fd":
        value: Any = rng.choice((0.0, -1.0, 1e-38, 1e30, float("inf"), float("nan"), 3e38))
    else:
        value = rng.choice(INTEGERS) & ((1 << 8 * struct.calcsize(kind)) - 1)
    code = struct.pack(rng.choice("<>") + kind, value)
    out[where : where + len(code)] = code


def remove(out: bytearray, rng: Random) -> None:
    where = at(out, rng)
    del out[where : where + rng.choice((1, 2, 4, rng.randint(1, 64)))]


def insert(out: bytearray, rng: Random) -> None:
    where = at(out, rng)
    new = rng.choice((b"\0", b"\xff", b"\n", bytes(rng.randrange(256) for _ in range(rng.randint(1, 8)))))
    out[where:where] = new * rng.choice((1, 1, 4, 300))


def copy_part(out: bytearray, rng: Random) -> None:
    begin, where, n = at(out, rng), at(out, rng), rng.randint(1, 64)
    out[where : where + rng.choice((0, n))] = out[begin : begin + n]


def truncate(out: bytearray, rng: Random) -> None:
    del out[at(out, rng) :]


def splice(out: bytearray, rng: Random, other: bytes) -> None:
    begin = rng.randrange(len(other))
    where = at(out, rng)
    out[where : where + rng.choice((0, 64, len(out)))] = other[begin : begin + rng.choice((16, 256, len(other)))]


BYTES = (flip, flip, put_byte, put_byte, put_number, put_number, remove, insert, copy_part, truncate)


# --- text -------------------------------------------------------------------------------------------------------------

_WORD = re.compile(rb"[^\s,=\[\]{}\"'/]+")


def _lines(out: bytearray) -> list[bytes]:
    return bytes(out).split(b"\n")


def word_to_number(out: bytearray, rng: Random) -> None:
    words = list(_WORD.finditer(out))
    if words:
        word = rng.choice(words)
        out[word.start() : word.end()] = rng.choice(NUMBERS).encode()


def word_to_word(out: bytearray, rng: Random) -> None:
    words = list(_WORD.finditer(out))
    if words:
        word, new = rng.choice(words), rng.choice(words).group()
        out[word.start() : word.end()] = new * rng.choice((1, 1, 1, 2))


def repeat_words(out: bytearray, rng: Random) -> None:
    lines = _lines(out)
    line = rng.randrange(len(lines))
    words = lines[line].split()
    if words:
        lines[line] += b" " + b" ".join([rng.choice(words)] * rng.choice((1, 2, 10, 3000)))
        out[:] = b"\n".join(lines)


def move_lines(out: bytearray, rng: Random) -> None:
    lines = _lines(out)
    begin, where = rng.randrange(len(lines)), rng.randrange(len(lines))
    part = lines[begin : begin + rng.choice((1, 1, 2, 5))]
    if rng.random() < 0.5:
        del lines[begin : begin + len(part)]
    if rng.random() < 0.7:
        lines[where:where] = part * rng.choice((1, 1, 2, 50))
    out[:] = b"\n".join(lines)


def swap_mark(out: bytearray, rng: Random) -> None:
    """Replace a punctuation mark by another, or by many of them."""
    marks = [i for i, byte in enumerate(out) if byte in b"[]{}(),.=:;\"'/#-+\\ \t"]
    if marks:
        where = rng.choice(marks)
        out[where : where + 1] = rng.choice((
            b"", b"[", b"]", b"{", b"}", b",", b"=", b".", b'"', b"'", b"'''", b"/", b"#", b"-", b"\\", b"\n", b"\r", b"\t",
            b"[" * 2000, b"{a=" * 500, b"a." * 1000, b"-" * 50, b"\\\n"))


TEXT = (word_to_number, word_to_number, word_to_number, word_to_word, word_to_word, repeat_words, move_lines, move_lines, swap_mark)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Return every (container, key) of a JSON tree; list indices are keys."""
    found, stack = [], [value]
    while stack:
        value = stack.pop()
        keys: Any = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        for key in keys:
            found.append((value, key))
            stack.append(value[key])
    return found


def mutate_tree(tree: Any, rng: Random, words: Sequence[str] = (), junk: Sequence[Any] = JUNK) -> Any:
    """Return a damaged copy of a JSON tree: values are deleted, duplicated, or replaced by junk, near numbers or other values.

    words: keys and strings that have a meaning in the format."""
    tree = copy.deepcopy(tree)
    for _ in range(1 if rng.random() < 0.4 else rng.randint(2, 6)):
        all_places = places(tree)
        if not all_places:
            return tree
        container, key = rng.choice(all_places)
        value, kind = container[key], rng.randrange(8)
        if kind == 0:
            del container[key]
        elif kind == 1 and isinstance(container, list):
            container[key:key] = [copy.deepcopy(value)] * rng.choice((1, 2, 20))
        elif kind == 2:
            other, place = rng.choice(all_places)
            container[key] = copy.deepcopy(other[place])
        elif kind == 3 and words and isinstance(container, dict):
            container[rng.choice(words)] = copy.deepcopy(value)
        elif kind == 4 and words and isinstance(value, str):
            container[key] = rng.choice(words)
        elif kind in (5, 6) and isinstance(value, int | float) and not isinstance(value, bool):
            near = -value, value + 1, value - 1, value * 2, value * 1e6, value / 1e6
            container[key] = rng.choice((*near, rng.choice(INTEGERS), rng.random()))
        else:
            container[key] = copy.deepcopy(rng.choice(junk))
    return tree
