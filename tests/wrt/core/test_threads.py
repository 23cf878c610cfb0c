"""Threads, and tasks on them."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial

import pytest

from tests.data import ROOT
from tests.refused import refused
from wrt.core.threads import run_all, run_growing, thread_count


def test_threads() -> None:
    assert thread_count(3) == 3 and 1 <= thread_count(None) <= (os.cpu_count() or 1)
    for wrong in (0, -1):
        with refused("threads", "must be 1 to"):
            thread_count(wrong)


@pytest.mark.parametrize("threads", [1, 4])
def test_run_all_runs_each_task_once_and_raises_the_first_error(threads: int) -> None:
    done: list[int] = []
    lock = threading.Lock()

    def task(i: int) -> None:
        if i in (5, 7):
            raise RuntimeError(f"task {i}")
        with lock:
            done.append(i)

    run_all([lambda i=i: task(i) for i in range(5)], threads)
    assert sorted(done) == list(range(5))
    with pytest.raises(RuntimeError, match="task 5"):
        run_all([lambda i=i: task(i) for i in range(5, 10)], threads)
    run_all([], threads)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_run_all_has_threads_of_its_own_after_a_fork() -> None:
    code = """if True:
        import os, threading
        from wrt.core.threads import run_all
        def threads():
            seen, both = set(), threading.Barrier(2)
            run_all([lambda: (both.wait(60.0), seen.add(threading.get_ident()))] * 2, 2)
            return len(seen)
        assert threads() == 2
        child = os.fork()
        if child == 0:
            raise SystemExit(threads())
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
    """
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)


@pytest.mark.parametrize("threads", [1, 2])
def test_run_growing_also_runs_what_tasks_give(threads: int) -> None:
    done: list[int] = []

    def begin(n: int) -> tuple[Callable[[], None], Callable[[], list[int]]]:
        assert threading.current_thread() is threading.main_thread()
        return partial(job, n), lambda: [n // 2, n - n // 2] if n > 1 else []

    def job(n: int) -> None:
        done.append(n)  # atomic in CPython
        if n == 3:
            raise ValueError("three")

    run_growing(begin, [16, 4], threads)
    assert sorted(done) == sorted([16] + 2 * [8] + 5 * [4] + 10 * [2] + 20 * [1])
    with pytest.raises(ValueError, match="three"):
        run_growing(begin, [5], threads)
