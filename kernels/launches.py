"""Launches that a kernel of the CPU makes: a loop over kernels without Python between them, and without its lock.

How Warp compiles a kernel for the CPU is no part of its documents: a C function of two addresses, of the launch's size
(launch_bounds_t) and of its arguments. The self-test of wrt.accel.queries.raw_launches holds it."""

import warp as wp


@wp.struct
class Launch:
    """A kernel that is compiled for the CPU, with its arguments: addresses that wrt.accel.queries.raw_launches keeps. For one
    thread at a time: launches write into it.

    entry: of the machine code, bounds: of the launch's size, args: of all arguments, tail: of the last of them; block: how many
    rays each of its threads takes, where it has a range of them.
    """

    entry: wp.uint64
    bounds: wp.uint64
    args: wp.uint64
    tail: wp.uint64
    block: int


@wp.func_native("""
    ((void (*)(void*, void*))launch.entry)((void*)launch.bounds, (void*)launch.args);
""")
def run(launch: Launch) -> None:
    """With the arguments that it had last."""


@wp.func_native("*(int*)launch.tail = last;")
def set_last(launch: Launch, last: int) -> None: ...


@wp.func_native("""
    int* const range = (int*)launch.tail - 1;
    range[0] = first;
    range[1] = end;
    auto* const bounds = (wp::launch_bounds_t<1>*)launch.bounds;
    bounds->size = bounds->shape[0] = (end - first + launch.block - 1) / launch.block;
""")
def set_range(launch: Launch, first: int, end: int) -> None: ...


@wp.func
def run_with(launch: Launch, last: int):
    """With that last argument, an int."""
    set_last(launch, last)
    run(launch)


@wp.func
def run_range(launch: Launch, first: int, end: int):
    """Of rays first .. end - 1; these are its last two arguments."""
    set_range(launch, first, end)
    run(launch)
