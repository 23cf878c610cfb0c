"""The self-test of hand-made launches detects each assumption about Warp that no longer holds."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.refused import refused

from tests.kernel_tools import cpu_only  # isort: skip
import warp as wp

from wrt.accel.queries import batches, raw_launches
from wrt.core import warp_private
from wrt.core.device import made_once, start
from wrt.core.errors import InputError

pytestmark = cpu_only


Code = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


class Longer(ctypes.Structure):
    """A record with a new field."""

    _fields_ = [("new", ctypes.c_int), ("record", warp_private.array_t)]


def transposed(data: int, ndim: int, shape: Any, strides: Any, array_t: Any = warp_private.array_t) -> Any:
    return array_t(data, ndim=ndim, shape=strides, strides=shape)


def elsewhere(data: int, ndim: int, shape: Any, strides: Any, array_t: Any = warp_private.array_t) -> Any:
    return array_t(grad=data, ndim=ndim, shape=shape, strides=strides)


def without_size(data: int, ndim: int, shape: Any, strides: Any, array_t: Any = warp_private.array_t) -> Any:
    return array_t(data, ndim=0)


def longer(data: int, ndim: int, shape: Any, strides: Any, array_t: Any = warp_private.array_t) -> Any:
    return Longer(0, array_t(data, ndim=ndim, shape=shape, strides=strides))


def other_size(launch: warp_private.Recorded) -> warp_private.Recorded:
    """Simulate a Warp whose kernels read their size from another address."""
    bounds, code = type(launch.owners[1])(1), Code(launch.entry)
    called = Code(lambda _, args: code(ctypes.addressof(bounds), args))
    return launch._replace(entry=ctypes.cast(called, ctypes.c_void_p).value, owners=(*launch.owners, bounds, code, called))


def other_last(launch: warp_private.Recorded) -> warp_private.Recorded:
    """Simulate a Warp whose launches have another argument after the last one."""
    return launch._replace(last=launch.last - 4)


def other_code(launch: warp_private.Recorded) -> warp_private.Recorded:
    called = Code(lambda bounds, args: None)
    return launch._replace(entry=ctypes.cast(called, ctypes.c_void_p).value, owners=(*launch.owners, called))


@pytest.fixture
def not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reset the state, as in a process without launches."""
    start("cpu")
    raw_launches.check_raw_launches()
    monkeypatch.setattr(raw_launches, "_test_once", made_once(raw_launches._test_once.__wrapped__))
    monkeypatch.setattr(batches, "tracer", made_once(batches.Tracer))  # existing tracers have tested workers


def query() -> Any:
    return wrt.build(wrt.Mesh(np.eye(3), np.array([[0, 1, 2]])), "bvh2").closest_hit(np.zeros((1, 3)), np.ones((1, 3))).t


def refused_for(differ: str) -> None:
    with pytest.raises(InputError) as error:
        raw_launches.check_raw_launches()
    assert str(error.value) == (f"Warp {wp.config.version} is not supported, its insides differ ({differ});"
                                f" install '{warp_private.WORKS_WITH}'")


@pytest.mark.usefixtures("not_tested")
def test_this_warp_passes_and_is_tested_once(monkeypatch: pytest.MonkeyPatch) -> None:
    raw_launches.check_raw_launches()
    monkeypatch.setattr(raw_launches, "_has_records", lambda *arrays: False)
    raw_launches.check_raw_launches()


@pytest.mark.usefixtures("not_tested")
@pytest.mark.parametrize("record", [transposed, elsewhere, without_size, longer])
def test_other_records_of_arrays_are_refused_before_anything_is_launched(record: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp_private, "array_t", record)
    monkeypatch.setattr(wp, "launch", None)
    refused_for("records of arrays")


@pytest.mark.usefixtures("not_tested")
def test_a_struct_of_another_layout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp_private, "struct_record", lambda struct, arrays: Longer(1, warp_private.array_record(*arrays)))
    refused_for("records of arrays")


@pytest.mark.usefixtures("not_tested")
@pytest.mark.parametrize("method", ["set", "set_dim"])
def test_launches_that_do_not_take_what_is_set_are_refused(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = getattr(warp_private.RawLaunch, method)

    def ignored(self: Any, *args: Any) -> None:
        if not isinstance(args[-1], int):
            plain(self, *args)

    monkeypatch.setattr(warp_private.RawLaunch, method, ignored)
    refused_for("arguments of launches")


@pytest.mark.usefixtures("not_tested")
@pytest.mark.parametrize("change", [other_size, other_last, other_code])
def test_other_launches_by_kernels_are_refused(change: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = warp_private.recorded
    monkeypatch.setattr(warp_private, "recorded", lambda command: change(recorded(command)))
    refused_for("launches by kernels")


@pytest.mark.usefixtures("not_tested")
def test_a_write_beside_the_array_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The write goes to the word before the array."""
    struct = warp_private.struct_record

    def longer(kind: Any, arrays: list[np.ndarray]) -> Any:
        return struct(kind, [np.ndarray(arrays[0].shape, np.int32, memory, offset=4 * raw_launches.GUARDS - 4)
                             if (memory := arrays[0].base) is not None else arrays[0]])

    monkeypatch.setattr(warp_private, "struct_record", longer)
    refused_for("arguments of launches")


@pytest.mark.usefixtures("not_tested")
def test_a_query_and_a_picture_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw_launches, "_launches_itself", lambda *arrays: False)
    monkeypatch.setattr(batches, "tracer", made_once(batches.Tracer))  # without workers of earlier queries
    scene = wrt.load_scene(ROOT / "scenes" / "whitted.toml")
    for ask in (query, lambda: wrt.render(scene, size=(8, 8), spp=1)):
        with refused(what="launches by kernels"):
            ask()
