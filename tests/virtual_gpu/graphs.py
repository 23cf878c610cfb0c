"""CUDA graphs of virtual GPUs: a capture records calls, a launch repeats them; calls that cannot be captured are refused."""

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
    """A captured graph, or a graph during its capture."""

    context: int
    calls: list[Call] = field(default_factory=list)  # The recorded calls, in order.
    # Addresses of memory allocated during the capture, and whether the host has freed them: they live as long as the graph.
    kept: dict[int, bool] = field(default_factory=dict)


@dataclass
class Counts:
    """The work of all devices so far. The launches and copies within a graph count each time that the graph is launched."""

    launches: Counter[tuple[str, int]] = field(default_factory=Counter)  # By the kernel's name and the device's number.
    copies: Counter[str] = field(default_factory=Counter)  # By direction: "h2d", "d2h", "d2d", or "p2p" (to another device).
    bytes: Counter[str] = field(default_factory=Counter)  # Bytes of copies, by direction.
    synchronisations: int = 0  # Waits of the host for a device.
    graphs: int = 0  # Launches of graphs.

    def __str__(self) -> str:
        copies = ", ".join(f"{n} {kind}" for kind, n in sorted(self.copies.items())) or "none"
        return (f"{self.launches.total()} launches of {len(self.launches)} kernels, copies: {copies},"
                f" {self.synchronisations} synchronisations")


class VirtualGpuError(RuntimeError):
    """An error of the program that a real GPU would report later or never."""


def address(pointer: Any) -> int:
    """Return the address of a pointer as Warp passes it: a number, a pointer of ctypes, or the structure itself."""
    if pointer is None or isinstance(pointer, int):
        return pointer or 0
    if hasattr(pointer, "_obj"):  # of ctypes.byref
        return ctypes.addressof(pointer._obj)
    if isinstance(pointer, ctypes.Structure | ctypes.Array):
        return ctypes.addressof(pointer)
    return ctypes.cast(pointer, ctypes.c_void_p).value or 0


class Graphs:
    """The part of Gpus that captures and launches graphs. active: the graphs during their capture, by context."""

    handles: Iterator[int]
    objects: dict[int, Any]
    streams: dict[int, int]
    active: dict[int, Graph]
    memory: Memory
    counts: Counts
    lock: Any

    def refuse(self, what: str) -> None:
        """Raise VirtualGpuError if a graph is being captured: `what` cannot be captured."""
        if self.active:
            raise VirtualGpuError(f"{what} while a graph is captured: CUDA refuses the call, or the graph would not repeat it")

    def do(self, context: int, call: Call) -> Any:
        """Call now, or, while a graph is captured, record the call."""
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
    """Copy the arguments of a launch, because a capture keeps their present values; return addresses, and the buffers.

    The first argument is the launch's bounds; kinds: the types of the others."""
    sizes = [bounds_size(dimensions), *map(argument_size, kinds)]
    held = [ctypes.create_string_buffer(ctypes.string_at(values[i], size), size) for i, size in enumerate(sizes)]
    return (ctypes.c_void_p * len(held))(*map(ctypes.addressof, held)), held
