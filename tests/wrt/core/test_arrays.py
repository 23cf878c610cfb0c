"""Arrays to and from others: the same memory, by its address."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from wrt.accel.answers import Hits
from wrt.accel.rays import rays_of, rays_on
from wrt.core.arrays import to_numpy, to_warp
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.scene.shapes import box

ORIGINS = np.full((5, 3), (0.1, 0.2, 5.0), np.float32)
DIRECTIONS = np.array([(0, 0, -1), (0, 0, 1), (0, 1, 0), (0.05, 0, -1), (0, 0.05, -1)], np.float32)


class Tensor:
    """What another library's array looks like: DLPack and nothing else."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __dlpack__(self, **options: Any) -> Any:
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self.array.__dlpack_device__()


def address(array: Any) -> int:
    return int(array.ptr if isinstance(array, wp.array) else array.__array_interface__["data"][0])


@pytest.fixture
def film() -> Film:
    rng = np.random.default_rng(0)
    return Film(rng.random((4, 6, 3), dtype=np.float32), np.zeros((4, 6, 3), np.float32), np.ones((4, 6), np.int32))


def test_a_film_is_its_pixels_everywhere(film: Film) -> None:
    here = address(film.pixels)
    assert address(np.asarray(film)) == address(film.numpy()) == address(np.from_dlpack(film)) == here
    on_warp = film.warp()
    assert address(on_warp) == here and on_warp.dtype == wp.vec3 and on_warp.shape == (4, 6)
    assert np.array_equal(on_warp.numpy(), film.pixels)
    assert np.asarray(film, dtype=np.float64).dtype == np.float64 and address(np.array(film, copy=True)) != here
    tensor = wp.from_dlpack(film)
    assert address(tensor) == here and tensor.shape == (4, 6, 3)


def test_a_film_that_another_made_of_a_strided_picture(film: Film) -> None:
    flipped = Film(film.pixels[::-1], film.variance, film.samples)
    assert np.array_equal(np.asarray(flipped), film.pixels[::-1]) and np.array_equal(flipped.warp().numpy(), film.pixels[::-1])


def test_hits_go_to_numpy_and_warp_and_back() -> None:
    hits = wrt.build(box()).closest_hit(ORIGINS, DIRECTIONS)
    for name in ("t", "u", "v", "prim_id"):
        array = getattr(hits, name)
        there, back = getattr(hits.warp(), name), getattr(hits.warp().numpy(), name)
        assert isinstance(there, wp.array) and isinstance(back, np.ndarray)
        assert address(array) == address(there) == address(back) == address(np.from_dlpack(array)), name
    assert hits.numpy().t is hits.t and hits.warp().warp().t.dtype == wp.float32


def same(a: Hits, b: Hits) -> bool:
    a, b = a.numpy(), b.numpy()
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("t", "u", "v", "prim_id"))


def test_rays_come_from_any_library() -> None:
    accel = wrt.build(box())
    expected = accel.closest_hit(ORIGINS, DIRECTIONS)
    assert (expected.prim_id >= 0).tolist() == [True, False, False, True, True]
    assert same(accel.closest_hit(Tensor(ORIGINS), Tensor(DIRECTIONS)), expected)
    assert same(accel.closest_hit(Tensor(ORIGINS), DIRECTIONS.tolist()), expected)
    on_warp = accel.closest_hit(to_warp(ORIGINS, wp.vec3), to_warp(DIRECTIONS, wp.vec3))
    assert isinstance(on_warp.t, wp.array) and same(on_warp, expected)


def test_rays_are_not_copied() -> None:
    accel = wrt.build(box())
    for origins, directions in ((ORIGINS, DIRECTIONS), (Tensor(ORIGINS), Tensor(DIRECTIONS)),
                                (to_warp(ORIGINS, wp.vec3), to_warp(DIRECTIONS, wp.vec3))):
        rays = rays_on(accel.device, rays_of(origins, directions, 0.0, np.inf))
        assert (address(rays.origin), address(rays.direction)) == (address(ORIGINS), address(DIRECTIONS))


def test_a_tensor_that_is_not_shared_is_told() -> None:
    class Attached(Tensor):
        def __dlpack__(self, **options: Any) -> Any:
            raise BufferError("requires gradient")

    with pytest.raises(InputError, match="origins: an Attached does not share its memory: requires gradient"):
        wrt.build(box()).closest_hit(Attached(ORIGINS), DIRECTIONS)
    with pytest.raises(InputError, match=r"directions must be \(N, 3\), got \(15,\)"):
        wrt.build(box()).closest_hit(ORIGINS, Tensor(DIRECTIONS.ravel()))


def test_what_cannot_be_written_to_is_copied() -> None:
    fixed = np.arange(6, dtype=np.float32)
    fixed.flags.writeable = False
    there = to_warp(fixed)
    assert address(there) != address(fixed) and np.array_equal(to_numpy(there), fixed)
