"""Arrays from and to other libraries share memory, by its address."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import wrt
from tests.device import NAME as DEVICE
from tests.kernel_tools import cpu_only
from tests.refused import refused
from wrt.accel.queries.answers import Hits
from wrt.accel.queries.arguments import rays_of
from wrt.accel.queries.rays import rays_on
from wrt.core.arrays import to_numpy, to_warp
from wrt.picture.film import Film
from wrt.scene.shapes import box, icosphere

ORIGINS = np.full((5, 3), (0.1, 0.2, 5.0), np.float32)
DIRECTIONS = np.array([(0, 0, -1), (0, 0, 1), (0, 1, 0), (0.05, 0, -1), (0, 0.05, -1)], np.float32)


class Tensor:
    """An array of another library, with DLPack alone."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __dlpack__(self, **options: Any) -> Any:
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self) -> Any:
        return self.array.__dlpack_device__()


class Library:
    """A library with the part of the array API that wrt uses: tensors return the namespace that has from_dlpack."""

    class Tensor(Tensor):
        def __array_namespace__(self, **options: Any) -> Any:
            return Library

        def __len__(self) -> int:
            return len(self.array)

        def __getitem__(self, rows: slice) -> Any:
            return Library.Tensor(self.array[rows])

        def __sub__(self, other: Any) -> Any:
            return Library.Tensor(self.array - other.array)

    @staticmethod
    def from_dlpack(array: Any) -> Any:
        return Library.Tensor(np.from_dlpack(array))


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


@cpu_only
def test_rays_are_not_copied() -> None:
    accel = wrt.build(box())
    for origins, directions in ((ORIGINS, DIRECTIONS), (Tensor(ORIGINS), Tensor(DIRECTIONS)),
                                (to_warp(ORIGINS, wp.vec3), to_warp(DIRECTIONS, wp.vec3))):
        rays = rays_on(accel.device, rays_of(origins, directions, 0.0, np.inf)[0])
        assert (address(rays.origin), address(rays.direction)) == (address(ORIGINS), address(DIRECTIONS))


def test_tensors_are_answered_by_tensors() -> None:
    accel, near = wrt.build(box()), np.float32([[0.1, 0.2, 0.3]] * 5)
    o, d, p = (Library.Tensor(array) for array in (ORIGINS, DIRECTIONS, near))
    hits, of_numpy = accel.closest_hit(o, d), accel.closest_hit(ORIGINS, DIRECTIONS)
    found, all_of_numpy, ones = wrt.all_hits(accel, o, d), wrt.all_hits(accel, ORIGINS, DIRECTIONS), np.ones(5)
    answers = {
        "t": (hits.t, of_numpy.t), "prim_id": (hits.prim_id, of_numpy.prim_id), "point": (hits.point, of_numpy.point),
        "normal": (hits.normal, of_numpy.normal), "first": (found.first, all_of_numpy.first), "all t": (found.t, all_of_numpy.t),
        "gradients": (hits.gradients(t=ones).vertices, of_numpy.gradients(t=ones).vertices),
        "ray_id": (found.ray_id, all_of_numpy.ray_id), "any_hit": (accel.any_hit(o, d), of_numpy.prim_id >= 0),
        "count_hits": (wrt.count_hits(accel, o, d), all_of_numpy.counts),
        "first_hits": (wrt.first_hits(accel, 1, o, d).t, of_numpy.t[:, None]),
        "contains": (wrt.contains(accel, p), np.full(5, True)), "visible": (wrt.visible(accel, p, o), np.full(5, False)),
        "t_max": (accel.closest_hit(ORIGINS, d, t_max=Library.Tensor(np.full(5, 2.0))).t, np.full(5, np.inf)),
    }
    for name, (ours, expected) in answers.items():
        assert isinstance(ours, Library.Tensor), name
        np.testing.assert_array_equal(ours.array, expected, err_msg=name)
    assert hits.t.array.ctypes.data % 64 == 0  # else JAX copies it
    accel.closest_hit(d, o, out=hits)
    np.testing.assert_array_equal(hits.t.array, accel.closest_hit(DIRECTIONS, ORIGINS).t)
    accel.refit(Library.Tensor(2.0 * accel.geometry.vertices))
    assert wrt.build((Library.Tensor(box().vertices), Library.Tensor(box().faces))).geometry.faces.shape == (12, 3)


class OnDevice:
    """A library whose tensors are on the device that tests run on."""

    class Tensor:
        def __init__(self, array: Any) -> None:
            self.array = array

        def __dlpack__(self, **options: Any) -> Any:
            on_cpu = self.array.device.is_cpu  # where NumPy knows the protocol's newer versions, and so that it may write
            return self.array.numpy().__dlpack__(**options) if on_cpu else self.array.__dlpack__(stream=options["stream"])

        def __dlpack_device__(self) -> Any:
            return self.array.__dlpack_device__()

        def __len__(self) -> int:
            return len(self.array)

        def __array_namespace__(self, **options: Any) -> Any:
            return OnDevice

    @staticmethod
    def from_dlpack(array: Any) -> Any:
        return OnDevice.Tensor(wp.from_dlpack(array))


def test_tensors_on_a_device_stay_there() -> None:
    accel, expected = wrt.build(box()), wrt.build(box(), device="cpu").closest_hit(ORIGINS, DIRECTIONS)
    o, d = (OnDevice.Tensor(wp.array(array, device=DEVICE)) for array in (ORIGINS, DIRECTIONS))
    end = OnDevice.Tensor(wp.full(5, 100.0, dtype=wp.float32, device=DEVICE))
    hits = accel.closest_hit(o, d, t_max=end)
    answers = {"t": (hits.t, expected.t), "prim_id": (hits.prim_id, expected.prim_id), "point": (hits.point, expected.point),
               "any_hit": (accel.any_hit(o, d), expected.prim_id >= 0),
               "all": (wrt.all_hits(accel, o, d).first, [0, 2, 2, 2, 4, 6]),
               "contains": (wrt.contains(accel, o), np.full(5, False)), "visible": (wrt.visible(accel, o, o), np.full(5, True))}
    for name, (ours, true) in answers.items():
        assert isinstance(ours, OnDevice.Tensor) and str(ours.array.device) == DEVICE, name
        np.testing.assert_array_equal(ours.array.numpy(), true, err_msg=name)
    by = hits.gradients(t=OnDevice.Tensor(wp.ones(5, dtype=wp.float32, device=DEVICE)))
    np.testing.assert_array_equal(by.origins.array.numpy(), expected.gradients(t=np.ones(5)).origins)
    again = accel.closest_hit(o, OnDevice.Tensor(wp.array(-DIRECTIONS, device=DEVICE)), out=hits)
    assert again.t.array.ptr == hits.t.array.ptr
    np.testing.assert_array_equal(hits.prim_id.array.numpy() >= 0, [False, True, False, False, False])


def test_a_tensor_that_is_not_shared_is_reported() -> None:
    class Attached(Tensor):
        def __dlpack__(self, **options: Any) -> Any:
            raise BufferError("requires gradient")

    with refused("origins", "Attached does"):
        wrt.build(box()).closest_hit(Attached(ORIGINS), DIRECTIONS)
    with refused("directions", "(..., 3)"):
        wrt.build(box()).closest_hit(ORIGINS, Tensor(DIRECTIONS.ravel()))


def test_read_only_arrays_are_copied() -> None:
    fixed = np.arange(6, dtype=np.float32)
    fixed.flags.writeable = False
    there = to_warp(fixed)
    assert address(there) != address(fixed) and np.array_equal(to_numpy(there), fixed)


class ForeignTensor:
    """A tensor on the CPU whose DLPack has another enumeration, or does not work, as in several libraries."""

    def __init__(self, values: np.ndarray, works: bool) -> None:
        self.values, self.works = values, works

    def __dlpack_device__(self) -> tuple[Any, int]:
        return SimpleNamespace(value=1), 0  # an enumeration whose members are not equal to integers

    def __dlpack__(self, **_: Any) -> Any:
        if not self.works:
            raise TypeError("no exchange of memory")
        return self.values.__dlpack__()

    def numpy(self) -> np.ndarray:
        return self.values


class NoNumpy(ForeignTensor):
    def numpy(self) -> np.ndarray:
        raise RuntimeError("this tensor is elsewhere")


@pytest.mark.parametrize("works", [True, False])
def test_foreign_tensors_are_read_like_arrays(works: bool) -> None:
    ball = icosphere(1)
    rays = np.random.default_rng(0).normal(size=(30, 6)).astype(np.float32)
    given, accel = ForeignTensor(rays, works), wrt.build((ForeignTensor(ball.vertices, works), ForeignTensor(ball.faces, works)))
    assert np.array_equal(accel.closest_hit(given).prim_id, accel.closest_hit(rays).prim_id)
    assert np.array_equal(accel.any_hit(given), accel.any_hit(rays))
    assert np.array_equal(wrt.all_hits(accel, given).prim_id, wrt.all_hits(accel, rays).prim_id)
    assert np.array_equal(wrt.count_hits(accel, given), wrt.count_hits(accel, rays))
    points = ForeignTensor(rays[:, :3].copy(), works)
    assert np.array_equal(wrt.closest_points(accel, points).distance, wrt.closest_points(accel, points.values).distance)
    assert np.array_equal(wrt.contains(accel, points), wrt.contains(accel, points.values))
    split = ForeignTensor(rays[:, 3:].copy(), works)
    assert np.array_equal(accel.closest_hit(points, split, t_max=ForeignTensor(rays[:, 0].copy(), works)).t,
                          accel.closest_hit(points.values, split.values, t_max=rays[:, 0].copy()).t)
    with refused("origins", "a tests.NoNumpy does not share its memory: no exchange", hint="pass a NumPy array"):
        accel.closest_hit(NoNumpy(rays, False))
