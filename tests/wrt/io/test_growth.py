"""Time and memory grow with a file's size, not with its square: files that repeat one thing, four and sixteen times as long.

Work is counted, not timed. Python calls a function before each line; it counts the line and looks up how much memory was allocated
for the line before, which also shows what C code copies: gluing a million lines together one by one is one line each, but allocates
all that is already there again and again. What C code only reads is not seen; nor is what the decoders of pictures allocate, which
`test_memory_kept` measures from outside.
"""

from __future__ import annotations

import math
import sys
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import pytest

from tests.fuzz.formats import read_mesh, read_picture, read_scene
from tests.fuzz.seeds import Seed, side_files
from tests.grown import GROWN
from wrt.core.errors import InputError

SIZE, LINES = 2400, 20_000  # bytes of the shortest file, or a fourth of it, or that of it, if it takes more lines
HIGHEST = 1.4  # exponent: 1 is linear, 2 is what must not be; tables that double when they are full make some difference
CONSTANT = 1 << 17  # bytes; and a hundredth of it in lines: what has no exponent
# What grows with the product of two counts, up to a limit.
UP_TO_A_LIMIT = {
    "gltf: nodes times primitives": "MAX_OBJECTS of them, see test_limits",
    "gltf: accessors of the same bytes": "what memory there is, see test_memory_kept",
}
# tomllib adds to a text piece by piece. Python does so in place, but not while lines are traced.
ADDED_TO = ("toml: string of escapes", "toml: string of quotes")


class Work(NamedTuple):
    """lines: of Python; allocated: bytes, all that were taken while a line ran, though they may be free again after it; peak: the
    most bytes at a time."""

    lines: int
    allocated: int
    peak: int


def work_of(action: Callable[[], object]) -> Work:
    lines = allocated = peak = 0

    def count(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal lines, allocated, peak, before
        now, top = tracemalloc.get_traced_memory()
        allocated += top - before
        peak = max(peak, top)
        lines += event == "line"
        tracemalloc.reset_peak()
        before = now
        return count

    tracer = sys.gettrace()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    sys.settrace(count)
    try:
        action()
    finally:
        sys.settrace(tracer)
        tracemalloc.stop()
    return Work(lines, allocated, peak)


def reading(seed: Seed, folder: Path) -> Work:
    path = folder / f"a{seed.suffix}"
    path.write_bytes(seed.data)
    read = {".toml": read_scene, ".gltf": read_scene, ".glb": read_scene, ".png": read_picture, ".hdr": read_picture}

    def action() -> None:
        try:
            read.get(seed.suffix, read_mesh)(path)
        except InputError:
            pass

    return work_of(action)


def exponents(works: list[Work]) -> dict[str, float]:
    """Of each count, from its growth between three files, each four times as long as the one before: what all of them need alike
    falls out. 0 where it does not grow."""
    found = {}
    for name, (one, four, sixteen) in zip(Work._fields, zip(*works, strict=True), strict=True):
        least = CONSTANT // 100 if name == "lines" else CONSTANT
        grown = sixteen - four > least and four > one
        found[name] = math.log((sixteen - four) / (four - one), 4) if grown else 0.0 if sixteen - four <= least else math.inf
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GROWN if name not in UP_TO_A_LIMIT])
def test_work_and_memory_are_linear(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.scene.model.MANY_VERTICES", 1 << 10, raising=False)
    side_files(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reading(GROWN[name](SIZE // 16), tmp_path)  # imports, caches
        size = next((size for size in (SIZE, SIZE // 4) if reading(GROWN[name](size), tmp_path).lines < LINES), SIZE // 16)
        works = [reading(GROWN[name](times * size), tmp_path) for times in (1, 4, 16)]
    found = exponents(works)
    if name in ADDED_TO:
        del found["allocated"]
    print(name, " ".join(f"{key} {value:.2f}" for key, value in found.items()), works[-1])
    assert max(found.values()) <= HIGHEST, (found, works)


def test_a_square_is_seen() -> None:
    """In lines, in what is allocated by C code, and in the peak."""

    def lines(n: int) -> None:
        for _ in range(n):
            for _ in range(n):
                pass

    def glue(n: int) -> None:
        text = [""]
        for _ in range(n):
            text[0] = text[0] + "a" * 100

    def keep(n: int) -> None:
        kept = []
        for i in range(n):
            kept.append(bytes(16 * i))

    for action, name in ((lines, "lines"), (glue, "allocated"), (keep, "peak")):
        found = exponents([work_of(lambda size=size, action=action: action(size * 40)) for size in (1, 4, 16)])
        assert found[name] == pytest.approx(2.0, abs=0.15), name
    linear = exponents([work_of(lambda size=size: [str(i) for i in range(10_000 * size)]) for size in (1, 4, 16)])
    assert max(linear.values()) < 1.2
