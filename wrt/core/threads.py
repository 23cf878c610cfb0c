"""Threads of the CPU: how many, the size of their stacks, and tasks on them."""

from __future__ import annotations

import contextlib
import operator
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache, partial
from typing import Any, TypeVar

from wrt.core.checks import shown
from wrt.core.errors import InputError

MOST_THREADS = 1 << 10
# Bytes of a stack. With 256 KiB queries crash, whose kernels have arrays on it, with 512 renders, and with 768 the compiler
# (Linux, x86-64).
STACK = 2 << 20
T = TypeVar("T")


def thread_count(threads: int | None) -> int:
    """The number of threads to use: as given, or one a core that this process may run on. Raises InputError for what is no
    number of threads."""
    if threads is not None:
        if isinstance(threads, bool) or not hasattr(threads, "__index__"):
            raise InputError(f"threads must be a whole number, got {shown(threads)}")
        if threads < 1:
            raise InputError(f"threads must be 1 or more, got {threads}")
        return operator.index(threads)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


# --- stacks ------------------------------------------------------------------------------------------------------------


@cache
def _stack_limit() -> float:
    """Bytes of the main thread's stack, and of a new thread's where threading.stack_size() is 0; infinite where the system has no
    limit that is known."""
    with contextlib.suppress(ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_STACK)[0]
        return float("inf") if limit == resource.RLIM_INFINITY else limit
    return float("inf")


@cache
def _changing_size(process: int) -> threading.Lock:
    """A process that was forked has one that nobody holds."""
    return threading.Lock()


@contextlib.contextmanager
def _large_stacks() -> Iterator[bool]:
    """Threads that start in the block have stacks of STACK bytes or more; it yields whether they would have anyway. If not, threads
    that the user starts meanwhile have them too. (threading.stack_size() cannot be asked without setting it.)"""
    with _changing_size(os.getpid()):
        before = threading.stack_size(STACK)
        large = (before or _stack_limit()) >= STACK
        if large:
            threading.stack_size(before)
        try:
            yield large
        finally:
            if not large:
                threading.stack_size(before)


_here = threading.local()  # large: whether this thread's stack is


def _has_stack() -> bool:
    """Whether this thread's stack has STACK bytes. A thread of the user counts as having what threads have that start now."""
    if not hasattr(_here, "large"):
        if threading.current_thread() is threading.main_thread():
            _here.large = _stack_limit() >= STACK
        else:
            with _large_stacks() as _here.large:
                pass
    return bool(_here.large)


def with_stack(task: Callable[[], T]) -> T:
    """Run a task that kernels or their compiler are part of: here, or on a thread with a large stack where this one's is small
    (they would end the process with a segmentation fault)."""
    return task() if _has_stack() else submit(task).result()


# --- tasks -------------------------------------------------------------------------------------------------------------


class Pool(ThreadPoolExecutor):
    """Threads with large stacks. They start when they are needed, and are kept.

    The standard pool takes no tasks when Python's main thread has ended. Then each task runs at once, in the thread that submits
    it; InputError where that one's stack is small.
    """

    def __init__(self, threads: int, name: str = "wrt") -> None:
        super().__init__(threads, name, initializer=partial(setattr, _here, "large", True))

    def submit(self, task: Callable[..., T], /, *arguments: Any, **named: Any) -> Future[T]:
        if threading.main_thread().is_alive():
            with _large_stacks():
                return super().submit(task, *arguments, **named)
        if not _has_stack():
            raise InputError("Python's main thread has ended, and the stack of this one is too small for kernels")
        future = Future[T]()
        try:
            future.set_result(task(*arguments, **named))
        except BaseException as error:
            future.set_exception(error)
        return future


@cache
def _pool(process: int) -> Pool:
    """Shared by all that the process runs. A process that was forked has a pool of its own."""
    return Pool(MOST_THREADS)


def submit(task: Callable[..., T], *arguments: Any) -> Future[T]:
    """Run a task on a thread of the process's pool."""
    return _pool(os.getpid()).submit(task, *arguments)


def run_all(tasks: Iterable[Callable[[], None]], threads: int) -> None:
    """Run all tasks on so many threads, this one among them; after the first error none is begun, and it is raised when those
    that run have ended."""
    with_stack(partial(_run_all, list(tasks), threads))


def _run_all(jobs: list[Callable[[], None]], threads: int) -> None:
    if threads == 1 or len(jobs) <= 1:
        for job in jobs:
            job()
        return
    left = deque(enumerate(jobs))
    errors: dict[int, BaseException] = {}

    def work() -> None:
        while True:
            try:
                i, job = left.popleft()
            except IndexError:
                return
            try:
                job()
            except BaseException as error:
                errors[i] = error
                left.clear()

    helpers: list[Future[None]] = []
    try:
        for _ in range(min(threads, len(jobs)) - 1):
            helpers.append(submit(work))
        work()
    finally:
        left.clear()
        wait([helper for helper in helpers if not helper.cancel()])  # none that has not begun
    if errors:
        raise errors.pop(min(errors))


def run_growing(begin: Callable[[Any], tuple[Callable[[], Any], Callable[[], Iterable[Any]]]], tasks: Iterable[Any],
                threads: int) -> None:
    """Run all tasks, and those that come of them, on so many threads.

    begin(task) gives the job to run on a thread, and what to call afterwards, which gives more tasks. Both calls are made on this
    thread. The first error is raised after the jobs that run have ended.
    """
    waiting, running = deque(tasks), dict[Future[Any], Callable[[], Iterable[Any]]]()
    try:
        while waiting or running:
            while waiting and len(running) < threads:
                job, after = begin(waiting.popleft())
                running[submit(job)] = after
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                after = running.pop(future)
                future.result()
                waiting.extend(after())
    finally:
        wait(running)
