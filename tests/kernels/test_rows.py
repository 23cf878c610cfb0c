"""Structs in rows: stored values are loaded again with all bits, and the generated C++ is as expected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.kernel_tools import floats, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.core.device import records
from wrt.kernels.rows import Rows
from wrt.kernels.structs import kernel


@wp.struct
class Corner:
    point: wp.vec3
    index: int


@wp.struct
class Thing:
    corner: Corner
    key: wp.uint32
    size: float
    at: wp.vec2


THINGS = Rows(Thing, 5, 2)

def test_rows_follow_one_another() -> None:
    assert (THINGS.first, THINGS.end) == (2, 10)
    assert (THINGS.field("key").first, THINGS.field("key").end) == (6, 7)
    assert (THINGS.field("corner").field("index").first, THINGS.field("at").end) == (5, 10)
    with pytest.raises(ValueError, match="nothing"):
        THINGS.field("nothing")


def copied(source: Rows, target: Rows, things: Any, without: tuple[str, ...] = ()) -> Any:
    """Return the values after storing to rows, copying to other rows and loading, and the other rows."""
    store, load, store_again, load_again = source.store(), source.load(*without), target.store(), target.load()

    @kernel
    def run(things: wp.array(dtype=Thing), rows: wp.array(dtype=wp.float32), out: wp.array(dtype=Thing)):
        for i in range(things.shape[0]):
            store(rows, i, things[i])
        i = int(0)
        while i < things.shape[0]:
            store_again(rows, i, load(rows, i))
            i = i + 1
        for i in range(things.shape[0]):
            out[i] = load_again(rows, i)

    rows, out = floats(np.full(target.end * target.length, np.nan)), zeros(len(things), Thing)
    launch(run, 1, wp.array(things, dtype=Thing, device=rows.device), rows, out)
    return out.numpy(), rows.numpy().reshape(-1, target.length)


def test_each_number_keeps_its_bits() -> None:
    rng = np.random.default_rng(0)
    things = records(Thing, 5)
    things[:] = np.frombuffer(rng.bytes(things.nbytes), things.dtype)  # NaN and denormals, too.
    out, rows = copied(THINGS, Rows(Thing, 5, THINGS.end), things)
    assert out.tobytes() == things.tobytes()
    numbers = np.frombuffer(things.tobytes(), np.uint32).reshape(5, -1).T
    np.testing.assert_array_equal(rows[2:].view(np.uint32), np.concatenate([numbers, numbers]))
    assert np.isnan(rows[:2]).all()  # Only the struct's rows are written.


def test_a_field_that_is_left_out_is_zero() -> None:
    things = records(Thing, 5)
    things["size"], things["key"], things["corner"]["index"] = 1.5, 2**32 - 1, np.arange(5)
    out, _ = copied(THINGS, Rows(Thing, 5, THINGS.end), things, ("corner", "key"))
    assert (out["size"] == 1.5).all() and not out["key"].any() and not out["corner"]["index"].any()
