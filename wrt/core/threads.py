"""CPU threads: their number, and tasks on them."""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache
from typing import Generic, ParamSpec, TypeVar

from wrt.core.checks import as_integer

MOST_THREADS = 1 << 10
P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


def thread_count(threads: int | None) -> int:
    """Return a checked number of threads. None: the number of cores that this process may run on."""
    if threads is not None:
        return as_integer(threads, "threads", 1, 1 << 20)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


class Pool(ThreadPoolExecutor):
    """Pool of threads. After the end of Python's main thread, where the standard pool refuses tasks, `submit` runs a task at once."""

    def submit(self, task: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        if threading.main_thread().is_alive():
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


def run_all(tasks: Iterable[Callable[[], None]], threads: int) -> None:
    """Run all tasks on `threads` threads, including this one. After an error no task starts; the error is raised in the end."""
    jobs = list(tasks)
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
        job()
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
        """Run a task with a free thing."""
        thing = self.take()
        result = task(thing)
        self.give(thing)
        return result
