"""CUDA graphs of virtual GPUs: what a capture records and a launch does again, and what must not be asked meanwhile."""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.virtual_gpu.memory import Memory
from tests.virtual_gpu.warp_private import argument_size, bounds_size

Call = Callable[[], Any]


@dataclass
class Graph:
    """calls: what is to be done, in order; kept: memory that was taken while it was captured, and whether the host has freed it,
    which is done when the graph goes."""

    context: int
    calls: list[Call] = field(default_factory=list)
    kept: dict[int, bool] = field(default_factory=dict)


@dataclass
class Counts:
    """What has been asked of all devices. launches: by the kernel's name and the device's number; copies: "h2d", "d2h", "d2d" and
    "p2p" (to another device), and their bytes; synchronisations: waits of the host for a device; graphs: launches of graphs,
    whose own launches and copies count too."""

    launches: Counter[tuple[str, int]] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    synchronisations: int = 0
    graphs: int = 0

    def __str__(self) -> str:
        copies = ", ".join(f"{n} {kind}" for kind, n in sorted(self.copies.items())) or "none"
        return (f"{self.launches.total()} launches of {len(self.launches)} kernels, copies: {copies},"
                f" {self.synchronisations} synchronisations")


class VirtualGpuError(RuntimeError):
    """What a GPU would answer with an error, later or never."""


def address(pointer: Any) -> int:
    """Of what Warp gives for a pointer: a number, ctypes' pointer, or a structure itself."""
    if pointer is None or isinstance(pointer, int):
        return pointer or 0
    if hasattr(pointer, "_obj"):  # of ctypes.byref
        return ctypes.addressof(pointer._obj)
    if isinstance(pointer, ctypes.Structure | ctypes.Array):
        return ctypes.addressof(pointer)
    return ctypes.cast(pointer, ctypes.c_void_p).value or 0


class Graphs:
    """The part of Gpus that captures and launches graphs. active: those that are captured, by context, one a device at most."""

    handles: Iterator[int]
    objects: dict[int, Any]
    streams: dict[int, int]
    active: dict[int, Graph]
    memory: Memory
    counts: Counts
    lock: Any

    def refuse(self, what: str) -> None:
        """Raise VirtualGpuError for what cannot be captured, while a graph is."""
        if self.active:
            raise VirtualGpuError(f"{what} while a graph is captured: CUDA refuses that, or does not do it again with the graph")

    def do(self, context: int, call: Call) -> Any:
        """At once, or where a graph is captured, when that is launched."""
        graph = self.active.get(context)
        if graph is None:
            return call()
        graph.calls.append(call)
        return True

    def cuda_graph_begin_capture(self, context: int, *args: Any) -> bool:
        self.active[context] = Graph(context)
        return True

    def cuda_graph_end_capture(self, context: int, stream: Any, out: Any) -> bool:
        out._obj.value = handle = next(self.handles)
        self.objects[handle] = self.active.pop(context)
        return True

    def cuda_graph_create_exec(self, context: int, stream: Any, graph: Any, out: Any) -> bool:
        out._obj.value = graph.value
        return True

    def cuda_graph_launch(self, graph: Any, stream: Any) -> bool:
        for call in self.objects[graph.value].calls:
            call()
        with self.lock:
            self.counts.graphs += 1
        return True

    def cuda_graph_destroy(self, context: int, graph: Any) -> bool:
        for at, freed in self.objects.pop(graph.value).kept.items():
            if freed:
                self.memory.free(at)
        return True

    def cuda_graph_exec_destroy(self, context: int, graph: Any) -> bool:
        return True

    def cuda_stream_is_capturing(self, stream: Any) -> int:
        return int(any(self.streams.get(context) == address(stream) for context in self.active))

    def cuda_stream_get_capture_id(self, stream: Any) -> int:
        return address(stream)


def copied(values: Any, dimensions: int, kinds: Iterable[Any]) -> tuple[Any, list[Any]]:
    """The arguments of a launch as they are now: CUDA copies them when it captures. The first is the launch's bounds, of so many
    dimensions; kinds: the types of the others. Also what holds the copies."""
    sizes = [bounds_size(dimensions), *map(argument_size, kinds)]
    held = [ctypes.create_string_buffer(ctypes.string_at(values[i], size), size) for i, size in enumerate(sizes)]
    return (ctypes.c_void_p * len(held))(*map(ctypes.addressof, held)), held
