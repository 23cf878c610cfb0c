"""CPU threads: their number, the size of their stacks, and tasks on them."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from typing import Generic, ParamSpec, TypeVar

from wrt.core.checks import as_integer

MOST_THREADS = 1 << 10
# Bytes of a stack. Kernels have arrays on it: queries crash with 256 KiB, renders with 512, the compiler with 768 (Linux, x86-64).
STACK = 2 << 20
P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")
_here = threading.local()  # large: this thread's stack has STACK bytes


def thread_count(threads: int | None) -> int:
    """Return a checked number of threads. None: the number of cores that this process may run on."""
    if threads is not None:
        return as_integer(threads, "threads", 1, 1 << 20)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


@cache
def _stack_limit() -> float:
    """Return the bytes of the main thread's stack, or infinity if unknown. New threads have the same if threading.stack_size() is 0."""
    try:
        import resource
    except ImportError:
        return float("inf")
    limit = resource.getrlimit(resource.RLIMIT_STACK)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


@cache
def _stack_size_lock(process: int) -> threading.Lock:
    """Return a process's lock of threading.stack_size(). No thread of a forked process would release the lock of its parent process."""
    return threading.Lock()


@contextmanager
def _large_stacks() -> Iterator[bool]:
    """Give threads that start in the block stacks of STACK bytes or more. Yield True if the default stack is that large.

    threading.stack_size() holds for the whole process, and each call sets it."""
    with _stack_size_lock(os.getpid()):
        before = threading.stack_size(STACK)
        large = (before or _stack_limit()) >= STACK
        if large:
            threading.stack_size(before)
        try:
            yield large
        finally:
            if not large:
                threading.stack_size(before)


def _has_stack() -> bool:
    """Return True if this thread's stack has STACK bytes. A user's thread is assumed to have the stack of threads that start now."""
    if not hasattr(_here, "large"):
        if threading.current_thread() is threading.main_thread():
            _here.large = _stack_limit() >= STACK
        else:
            with _large_stacks() as _here.large:
                pass
    return bool(_here.large)


class Pool(ThreadPoolExecutor):
    """Pool of threads with large stacks. After the end of Python's main thread, where the standard pool refuses tasks, `submit` runs a task
    at once."""

    def __init__(self, threads: int, name: str = "wrt") -> None:
        super().__init__(threads, name, initializer=partial(setattr, _here, "large", True))

    def submit(self, task: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        if threading.main_thread().is_alive():
            with _large_stacks():
                return super().submit(task, *arguments, **named)
        future = Future[T]()
        try:
            future.set_result(task(*arguments, **named))
        except BaseException as error:
            future.set_exception(error)
        return future


@cache
def _pool(process: int) -> Pool:
    """Return the pool of a process; a forked process needs its own."""
    return Pool(MOST_THREADS, "wrt")


def submit(task: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> Future[T]:
    """Run a task on a thread of the process's pool."""
    return _pool(os.getpid()).submit(task, *arguments, **named)


def with_stack(task: Callable[[], T]) -> T:
    """Run a task that runs or compiles kernels; on another thread if the stack of this thread is small.

    On a small stack, kernels and the compiler end the process with a segmentation fault."""
    return task() if _has_stack() else submit(task).result()


def run_all(tasks: Iterable[Callable[[], None]], threads: int) -> None:
    """Run all tasks on `threads` threads, including this one. After an error no task starts; the error is raised in the end."""
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
        wait([helper for helper in helpers if not helper.cancel()])  # cancels helpers that have not begun
    if errors:
        raise errors.pop(min(errors))


def run_growing(begin: Callable[[T], tuple[Callable[[], object], Callable[[], Iterable[T]]]], tasks: Iterable[T], threads: int) -> None:
    """Run all tasks, and the further tasks that they produce, on `threads` threads.

    begin(task) returns (job, after). after() is called when the job has ended, and returns further tasks. Jobs run on other threads,
    or on this one if `threads` is 1; begin and after run on this thread. The first error is raised when all running jobs have ended."""
    waiting, running = deque(tasks), dict[Future[object], Callable[[], Iterable[T]]]()
    while waiting and threads == 1:
        job, after = begin(waiting.popleft())
        with_stack(job)
        waiting.extend(after())
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


class FreeList(Generic[T]):
    """Things that no thread uses now (`free`), for all threads. make: function that makes one more. After an exception a thing is not
    given back, because another thread may still use it."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make
        self.free: list[T] = []

    def take(self) -> T:
        """Return a free thing, or a new one if none is free."""
        try:
            return self.free.pop()
        except IndexError:
            return self._make()

    def give(self, thing: T) -> None:
        """Make a thing free again."""
        self.free.append(thing)

    def run(self, task: Callable[[T], R]) -> R:
        """Run a task, which may launch kernels, with a free thing."""
        def run() -> R:
            thing = self.take()
            result = task(thing)
            self.give(thing)
            return result

        return with_stack(run)
