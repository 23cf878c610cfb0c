"""InputError: its fields, and the message made from its fields."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import pytest

from wrt.core.checks import unknown
from wrt.core.errors import END, LONGEST, InputError, InputErrors, at, wrong


class Special(InputError):
    def __init__(self, count: int) -> None:
        super().__init__(f"must be more than {count}", argument="count")


@pytest.mark.parametrize(("error", "text"), [
    (InputError("the scene has no camera"), "the scene has no camera"),
    (InputError("must be 1 or more, got 0", argument="spp"), "spp must be 1 or more, got 0"),
    (InputError("monkeys have no scale", argument="keys"), "keys: monkeys have no scale"),
    (InputError("no camera 'x'", argument="camera", hint="there is 'main'"), "no camera 'x'; there is 'main'"),
    (InputError("is truncated", path=Path("a.ply")), "a.ply: is truncated"),
    (InputError("must be 3 numbers", argument="scale", path="a.gltf", place="nodes[3]", hint="leave it out"),
     "a.gltf: nodes[3]: scale must be 3 numbers; leave it out"),
    (InputErrors("2 errors\n  a: is missing\n  b: is missing", [InputError("is missing", place=each) for each in "ab"], path="a.toml"),
     "a.toml: 2 errors\n  a: is missing\n  b: is missing"),
    (wrong("camera 'a: b': fov_y", "must be a number"), "camera 'a: b': fov_y must be a number"),
    (unknown("sp", "setting", ["spp", "size"], argument="sp"), "unknown setting 'sp'; did you mean 'spp'? known are 'spp', 'size'"),
    (unknown("x", "material", [], place="quads[0].material"), "quads[0].material: unknown material 'x'; there are none"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_the_message_is_where_what_and_hint(error: InputError, text: str) -> None:
    assert str(error) == text


def test_a_place_in_a_name_is_split_off() -> None:
    error = wrong("camera 'a: b': fov_y", "must be a number", "degrees are for files")
    assert (error.place, error.argument, error.what, error.hint) == ("camera 'a: b'", "fov_y", "must be a number", "degrees are for files")


def test_places_and_files_are_put_in_front() -> None:
    error = InputError("must be finite", argument="scale", place="matrix").at(place="nodes[3]").at("a.gltf")
    assert (error.path, error.place, error.argument, error.outside) == ("a.gltf", "nodes[3]: matrix", "scale", None)
    outer = error.at(place="include[0]").at("scene.toml", hint="see its line 7")
    assert (outer.path, outer.place, outer.outside) == ("a.gltf", "nodes[3]: matrix", "scene.toml: include[0]")
    assert str(outer) == "scene.toml: include[0]: a.gltf: nodes[3]: matrix: scale must be finite; see its line 7"
    assert str(error) == "a.gltf: nodes[3]: matrix: scale must be finite"  # the first error is unchanged


def test_the_error_of_the_block_is_the_cause() -> None:
    with pytest.raises(InputError) as caught, at("quads[0]", "a.toml"):
        raise Special(3) from KeyError("x")
    assert type(caught.value) is Special and (caught.value.path, caught.value.place) == ("a.toml", "quads[0]")
    cause = caught.value.__cause__
    assert type(cause) is Special and cause.path is None and isinstance(cause.__cause__, KeyError)


@pytest.mark.parametrize("error", [
    InputError("is wrong", argument="a", path=Path("b"), place="c", hint="d").at("e"), Special(5).at("f", "g"),
    InputErrors("2 errors", [InputError("x", place="y"), Special(7)], path="a.toml")], ids=["plain", "subclass", "several"])
@pytest.mark.parametrize("again", [lambda e: pickle.loads(pickle.dumps(e)), copy.copy, copy.deepcopy], ids=["pickle", "copy", "deepcopy"])
def test_copies_have_the_same_fields(error: InputError, again) -> None:
    other = again(error)
    assert type(other) is type(error) and str(other) == str(error) and other.args == error.args
    assert {k: v for k, v in vars(other).items() if k != "errors"} == {k: v for k, v in vars(error).items() if k != "errors"}
    assert list(map(str, getattr(other, "errors", ()))) == list(map(str, getattr(error, "errors", ())))


def test_a_long_line_is_cut_in_the_message_alone() -> None:
    error = InputError("x" * 20000 + "end\nshort", path="p")
    long, last = str(error).split("\n")
    assert len(long) == LONGEST and long.startswith("p: xxx") and long.endswith("xend") and "..." in long and last == "short"
    assert long.index("...") == LONGEST - END - 3 and len(error.what) > 20000
