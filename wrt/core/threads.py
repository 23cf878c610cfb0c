"""Threads of the CPU: how many, and tasks on them."""

from __future__ import annotations

import contextlib
import operator
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import cache
from queue import SimpleQueue
from typing import Any, TypeVar

from wrt.core.checks import shown
from wrt.core.errors import InputError

MOST_HELPERS = 1 << 10
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


class _Helper:
    """A thread that does what it is given, one thing after another: to start one takes as long as to trace thousands of rays. (One
    of concurrent.futures takes 0.03 ms longer to begin and to end, of 1 for 100,000 rays on two threads.)"""

    def __init__(self, idle: deque[_Helper]) -> None:
        self.idle, self.given = idle, threading.Lock()
        self.given.acquire()
        threading.Thread(target=self._wait, name="wrt helper", daemon=True).start()

    def do(self, work: Callable[[], None]) -> None:
        """work raises nothing."""
        self.work = work
        self.given.release()

    def _wait(self) -> None:
        while True:
            self.given.acquire()
            self.work()
            del self.work
            self.idle.append(self)


@cache
def _idle(process: int) -> deque[_Helper]:
    """Those that wait. A process that was forked has none of its parent's."""
    return deque()


def _helper() -> _Helper:
    idle = _idle(os.getpid())
    try:
        return idle.pop()
    except IndexError:
        return _Helper(idle)


def taken_from(things: deque[T]) -> list[T]:
    """All of them; other threads may take or add some meanwhile."""
    out = []
    with contextlib.suppress(IndexError):
        while True:
            out.append(things.popleft())
    return out


def run_all(tasks: Iterable[Callable[[], None]], threads: int) -> None:
    """Run all tasks on so many threads, this one among them; after the first error none is begun, and it is raised when those
    that run have ended."""
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

    places, ended = deque(range(min(threads, len(jobs), MOST_HELPERS) - 1)), SimpleQueue[None]()

    def help_out() -> None:
        try:
            places.pop()
        except IndexError:  # too late
            return
        work()
        ended.put(None)

    helpers = len(places)
    try:
        for _ in range(helpers):
            _helper().do(help_out)
        work()
    finally:
        left.clear()
        for _ in range(helpers - len(taken_from(places))):
            ended.get()
    if errors:
        raise errors.pop(min(errors))


def run_growing(begin: Callable[[Any], tuple[Callable[[], Any], Callable[[], Iterable[Any]]]], tasks: Iterable[Any],
                threads: int) -> None:
    """Run all tasks, and those that come of them, on so many threads.

    begin(task) gives the job to run on a thread, and what to call afterwards, which gives more tasks. Both calls are made on this
    thread. The first error is raised after the jobs that run have ended.
    """
    with ThreadPoolExecutor(threads) as pool:
        running: dict[Future[Any], Callable[[], Iterable[Any]]] = {}

        def submit(task: Any) -> None:
            job, after = begin(task)
            running[pool.submit(job)] = after

        for task in tasks:
            submit(task)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
                for task in running.pop(future)():
                    submit(task)
