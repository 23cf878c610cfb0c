"""What a TOML text asks of tomllib is counted before, and no less than what it takes."""

from __future__ import annotations

import contextlib
import tomllib
import tracemalloc

import pytest

from tests.fuzz.seeds import SCENE, SMALL_SCENE
from tests.grown import GROWN
from wrt.core.errors import InputError
from wrt.io.toml.limits import MAX_PARTS, MAX_WORD, look_at

LONG = ".".join("a" * MAX_PARTS)


@pytest.mark.parametrize("text", [
    SCENE, SMALL_SCENE, f"{LONG} = 1", f"[{LONG}]\n{LONG} = 1", f'# {LONG}.a.b = 1\n"{LONG}.a.b" = 1', f"x = '{LONG}.a.b'",
    f'x = """\n{LONG}.a.b = 1\n"" \\"""{LONG}.a.b = 1""""', f"x = '''\n{LONG}.a.b = 1\n''{LONG}.a = 1'''''", "'#' = 1 # '",
    f"x = 1979-05-27 07:32:00.999 # {LONG}.a", f'{"a" * MAX_WORD} = "{"b" * 9999}"', f"x = {'1' * MAX_WORD}.5",
])
def test_what_is_sound_is_let_through(text: str) -> None:
    look_at(text)
    with contextlib.suppress(ValueError):  # thousands of digits
        tomllib.loads(text)


@pytest.mark.parametrize(("text", "message"), [
    (f"{LONG}.a = 1", "line 1, column 1: a key of more than 16 parts"),
    (f"x = 1\n [{LONG}.a]", "line 2, column 3: a key of more than 16 parts"),
    (f"[[ {LONG}.a ]]", "line 1, column 4: a key"),
    (" . ".join(["a"] * 17) + " = 1", "a key of more than 16 parts"),
    (".".join(["''", '"\\""', "a-_1"] * 6) + "=1", "a key of more than 16 parts"),
    (f'x = {{ y = "#", {LONG}.a = 1 }}', "line 1, column 16: a key of more than 16 parts"),
    (f"x = '''\n'''\n{LONG}.a = 1", "line 3, column 1: a key"), (f'x = """\\"""" # "\n{LONG}.a = 1', "line 2, column 1: a key"),
    ("a" * (MAX_WORD + 1) + " = 1", "line 1, column 1: a name without quotes of more than 4096 characters"),
    ("x = 1_" + "1" * MAX_WORD, "line 1, column 5: a number of more than 4096 characters"),
    ("x = 0." + "1" * (MAX_WORD + 1), "column 5: a number of more"),
])
def test_what_is_not(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        look_at(text)


@pytest.mark.parametrize("name", [name for name in GROWN if name.startswith("toml: ")])
def test_the_estimate_is_no_less_than_what_is_taken(name: str) -> None:
    text = GROWN[name](20_000).data.decode()
    try:
        asked = look_at(text)
    except InputError:
        return
    tracemalloc.start()
    with contextlib.suppress(ValueError, RecursionError):
        tomllib.loads(text)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < asked.bytes + 50_000, f"{peak / len(text):.0f} bytes a byte, {asked.bytes / len(text):.0f} estimated"


@pytest.mark.parametrize("piece", ['"""\\"', "'''a'", '"\\', '"a', "a.", '"""', '["""\\',
                                  " ", "\t[ ", " [ \n", "a ", "a .", "''", "[", "'"])
def test_a_walk_is_one_walk(piece: str) -> None:
    """A minute and more if any pattern went back: no clock is needed to see it."""
    with contextlib.suppress(InputError):
        look_at(piece * 300_000)
