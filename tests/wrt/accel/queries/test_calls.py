"""Calls with NumPy arrays: which are read in place or converted, where results go, and the overhead of a call."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.kernel_tools import DEVICE
from tests.refused import Refusal, refused
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.batches import FEWEST
from wrt.accel.scenes.build import build
from wrt.core.arrays import to_numpy, to_warp
from wrt.kernels.query import FARTHEST, LARGEST
from wrt.scene.shapes import box, icosphere

NAMES = "bvh8", "bvh2"  # with and without a kernel for many rays at a time
MANY = 2 * FEWEST + 77
FIELDS = "t", "u", "v", "prim_id"


@pytest.fixture(scope="module", params=NAMES)
def ball(request: pytest.FixtureRequest) -> Accelerator:
    return build(icosphere(3), request.param)


def some_rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = (2.0 * rng.normal(size=(n, 3))).astype(np.float32)
    return origins, (0.5 * rng.normal(size=(n, 3)) - origins).astype(np.float32)


def bits(hits: Hits) -> list[bytes]:
    return [to_numpy(getattr(hits, name)).tobytes() for name in FIELDS]


def unaligned(a: np.ndarray) -> np.ndarray:
    memory = np.zeros(a.nbytes + 1, np.uint8)
    memory[1:] = np.frombuffer(a.tobytes(), np.uint8)
    return memory[1:].view(a.dtype).reshape(a.shape)


def frozen(a: np.ndarray) -> np.ndarray:
    a = a.copy()
    a.flags.writeable = False
    return a


FORMS = {
    "float64": lambda a: a.astype(np.float64), "big-endian": lambda a: a.astype(">f4"), "fortran": np.asfortranarray,
    "strided": lambda a: np.repeat(a, 2, axis=0)[::2], "reversed": lambda a: a[::-1].copy()[::-1], "unaligned": unaligned,
    "columns": lambda a: np.concatenate([a, a], axis=-1)[..., : a.shape[-1]], "frozen": frozen, "list": lambda a: a.tolist(),
}


@pytest.mark.parametrize("n", [3, FEWEST, MANY])
@pytest.mark.parametrize("form", FORMS)
def test_arrays_of_any_form_give_the_same_bits(ball: Accelerator, form: str, n: int) -> None:
    origins, directions = some_rays(n)
    t_min, t_max = np.float32(0.05 * np.arange(n) / n), np.float32(0.2 + np.arange(n) % 3)
    expected, occluded = ball.closest_hit(origins, directions, t_min, t_max), ball.any_hit(origins, directions, t_min, t_max)
    assert 0 < (expected.prim_id >= 0).sum() < n and np.array_equal(occluded, expected.prim_id >= 0)
    given = [FORMS[form](array) for array in (origins, directions, t_min, t_max)]
    for threads in (1, 2):
        assert bits(ball.closest_hit(*given, threads=threads)) == bits(expected)
        assert np.array_equal(ball.any_hit(*given, threads=threads), occluded)
    assert bits(ball.closest_hit(origins, given[1], t_min, given[3])) == bits(expected)  # mixed


@pytest.mark.parametrize("n", [5, MANY])
def test_one_number_for_all_segments_is_as_an_array_of_it(ball: Accelerator, n: int) -> None:
    origins, directions = some_rays(n)
    for t_min, t_max in ((0.0, np.inf), (0.25, 1.0), (np.float32(0.5), 2), (0, np.float64(1e300)), (-1e-60, -1.0)):
        ends = [np.full(n, end, np.float64) for end in (t_min, t_max)]
        with np.errstate(over="ignore"):
            asked = ball.closest_hit(origins, directions, *ends)
        assert bits(ball.closest_hit(origins, directions, t_min, t_max)) == bits(asked)
        on_warp = ball.closest_hit(to_warp(origins, wp.vec3), to_warp(directions, wp.vec3), t_min, t_max)
        assert isinstance(on_warp.t, wp.array) and bits(on_warp) == bits(asked)


# --- where results go -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_warp", [False, True])
@pytest.mark.parametrize("n", [0, 1, 1000, MANY])
def test_answers_go_where_the_caller_says(ball: Accelerator, n: int, as_warp: bool) -> None:
    rays: tuple[Any, ...] = some_rays(n)
    expected, dark = ball.closest_hit(*rays, threads=1), ball.any_hit(*rays)
    room: list[Any] = [np.full(n, 7, np.int32 if name == "prim_id" else np.float32) for name in FIELDS] + [np.ones(n, bool)]
    if as_warp:
        rays, room = tuple(to_warp(a, wp.vec3) for a in rays), [to_warp(a).to(DEVICE) for a in room]
    out = Hits(*room[:4])
    for threads in (1, 2):
        hits = ball.closest_hit(*rays, threads=threads, out=out)
        assert all(getattr(hits, name) is array for name, array in zip(FIELDS, room, strict=False))
        assert bits(hits) == bits(expected)
        assert ball.any_hit(*rays, threads=threads, out=room[4]) is room[4] and np.array_equal(to_numpy(room[4]), dark)
    counted = ball.closest_hit(*rays, counters=True, out=out)
    assert bits(counted) == bits(expected) and counted.t is room[0] and len(counted.counters.counts) == n  # type: ignore[union-attr]
    assert out.counters is None


@pytest.mark.parametrize(("field", "array", "message"), [
    ("t", np.zeros(4, np.float32), ("out.t", "NumPy array (3,)")),
    ("t", np.zeros(3), ("out.t", "float32")),
    ("u", np.zeros((3, 1), np.float32), ("out.u", "(3,)")), ("v", np.zeros(6, np.float32)[::2], ("out.v", "contiguous")),
    ("v", frozen(np.zeros(3, np.float32)), ("out.v", "writeable")), ("prim_id", np.zeros(3, np.int64), ("out.prim_id", "int32")),
    ("prim_id", [0, 0, 0], ("out.prim_id", "NumPy array")), ("t", None, ("out.t", "NumPy array")),
    ("t", "warp", ("out.t", "NumPy array (3,)")),
])
def test_room_that_does_not_fit_is_named(ball: Accelerator, field: str, array: Any, message: Refusal) -> None:
    rays = some_rays(3)
    room = {name: np.zeros(3, np.int32 if name == "prim_id" else np.float32) for name in FIELDS}
    room[field] = wp.zeros(3, dtype=wp.float32, device="cpu") if isinstance(array, str) else array  # type: ignore[assignment]
    with refused(*message):
        ball.closest_hit(*rays, out=Hits(**room))


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("form", ["as it is", "float64", "fortran"])
@pytest.mark.parametrize("n", [100, MANY])
def test_the_first_row_that_is_wrong_is_named(ball: Accelerator, n: int, form: str) -> None:
    good = *some_rays(n), np.zeros(n, np.float32), np.ones(n, np.float32)
    last = n - 1
    for which, value, rows, *message in (
            (0, np.nan, (last,), "origins", f"finite; row {last} is"), (0, -np.inf, (n // 2, last), "origins", f"row {n // 2} is"),
            (0, 1.1e37, (last, 7), "origins", "within 1e+37; row 7 is"),
            (1, np.inf, (0, last), "directions", "finite; row 0 is"),
            (1, 0.0, (n - 2, last), "directions", f"zero; row {n - 2} is"),
            (2, np.nan, (last,), "t_min"), (2, -1e-30, (last,), "t_min", "below 0"),
            (3, np.nan, (last,), "t_max", "NaN")):
        arrays = [array.copy() for array in good]
        arrays[which][list(rows)] = value
        if form != "as it is":
            arrays = [FORMS[form](array) for array in arrays]
        for threads in (1, 2):
            for query in (ball.closest_hit, ball.any_hit):
                with refused(*message):
                    query(*arrays, threads=threads)  # type: ignore[operator]
    arrays = [array.copy() for array in good]
    arrays[3][::2] = -np.inf  # an empty segment is valid
    assert (ball.closest_hit(*arrays).prim_id[::2] == -1).all()


def test_numbers_of_warp_arrays_are_not_looked_at_but_for_segments(ball: Accelerator) -> None:
    origins, directions = some_rays(MANY)
    expected = ball.closest_hit(origins, directions).prim_id
    origins[5], directions[6], directions[7] = np.nan, 0.0, np.inf
    on_warp = to_warp(origins, wp.vec3), to_warp(directions, wp.vec3)
    found = ball.closest_hit(*on_warp).numpy().prim_id
    np.testing.assert_array_equal(np.delete(found, [5, 6, 7]), np.delete(expected, [5, 6, 7]))
    ends = np.ones(MANY, np.float32)
    ends[-1] = np.nan
    with refused("t_max", "NaN"):
        ball.closest_hit(*on_warp, t_max=to_warp(ends))


def test_a_structure_answers_after_an_error(ball: Accelerator) -> None:
    origins, directions = some_rays(MANY)
    expected = bits(ball.closest_hit(origins, directions))
    wrong = origins.copy()
    wrong[3] = np.nan
    for _ in range(3):
        with refused("origins", "row 3"):
            ball.closest_hit(wrong, directions, threads=2)
        assert bits(ball.closest_hit(origins, directions, threads=2)) == expected


# --- what a call costs ------------------------------------------------------------------------------------------------


def test_rays_in_place_need_no_memory_of_their_size() -> None:
    accel = build(icosphere(1), "bvh8", device="cpu")
    n = 20 * FEWEST
    origins, directions = some_rays(n)
    out, dark = accel.closest_hit(origins, directions), accel.any_hit(origins, directions)

    def peak(*arguments: Any, **options: Any) -> float:
        """Return the peak memory of a call in bytes per ray."""
        accel.closest_hit(*arguments, threads=1, **options)
        tracemalloc.start()
        try:
            accel.closest_hit(*arguments, threads=1, **options)
            return tracemalloc.get_traced_memory()[1] / n
        finally:
            tracemalloc.stop()

    assert peak(origins, directions, 0.0, 5.0, out=out) < 1.0
    assert 16.0 <= peak(origins, directions) < 17.0  # the results
    assert peak(origins.astype(np.float64), np.asfortranarray(directions), np.zeros(n), 5.0, out=out) < 1.0
    assert dark.nbytes == n


# --- the largest coordinates ------------------------------------------------------------------------------------------



@pytest.mark.parametrize("n", [1, 64])  # one ray, and packets
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limits_themselves_are_accepted(n: int, sign: float) -> None:
    accel = wrt.build(box())
    far, near = np.zeros((n, 3), np.float32), np.full((n, 3), (0.1, 0.2, 5.0), np.float32)
    far[:, 1] = sign * float(FARTHEST)
    down, fast = np.full((n, 3), (0.0, 0.0, -1.0), np.float32), np.full((n, 3), (0.0, 0.0, -float(LARGEST)), np.float32)
    assert (accel.closest_hit(far, down).prim_id == -1).all()
    hits = accel.closest_hit(near, fast)
    assert (hits.prim_id >= 0).all() and (hits.t <= np.float32(5.0) / np.float32(LARGEST)).all()
    with pytest.raises(wrt.InputError):
        accel.closest_hit(np.nextafter(far, np.float32(sign * np.inf)), down)


@pytest.mark.parametrize("as_warp", [False, True])
def test_arrays_that_share_memory_are_refused(ball: Accelerator, as_warp: bool) -> None:
    """Arrays of different types or that share only a part are refused, too. Adjacent arrays are accepted."""
    rays: tuple[Any, ...] = some_rays(4)
    memory, own = np.zeros(16, np.float32), [np.zeros(4, np.float32) for _ in range(2)]
    whole: Any = to_warp(memory).to(DEVICE) if as_warp else memory
    if as_warp:
        rays, own = tuple(to_warp(a, wp.vec3) for a in rays), [to_warp(a).to(DEVICE) for a in own]

    def ids(begin: int) -> Any:
        part = whole[begin:begin + 4]
        return part.view(wp.int32) if as_warp else part.view(np.int32)

    t = whole[:4]
    for room, named in (((t, own[0], t, ids(8)), ("out.t", "out.v")), ((own[0], own[1], t, ids(0)), ("out.v", "out.prim_id")),
                        ((own[0], t, whole[3:7], ids(8)), ("out.u", "out.v")), ((whole[5:9], own[0], own[1], ids(2)),
                                                                             ("out.t", "out.prim_id"))):
        with refused(*named):
            ball.closest_hit(*rays, out=Hits(*room))
    room = t, whole[4:8], whole[12:], ids(8)
    assert bits(ball.closest_hit(*rays, out=Hits(*room))) == bits(ball.closest_hit(*rays))
