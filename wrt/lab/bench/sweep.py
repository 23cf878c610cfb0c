"""Sweeps on the workers of an executor. What is counted may be computed anywhere; what is timed goes as whole cases: a mesh with
all that is compared on it is measured by one worker. A process does one task of a sweep at a time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, CancelledError
from dataclasses import replace
from pathlib import Path
from typing import Any

from wrt.core.errors import InputError
from wrt.renderer.distributed.installed import DIGEST
from wrt.renderer.distributed.workers import worker_name
from wrt.scene.mesh import Mesh

_alone = threading.Lock()


def submitter(executor: Any) -> Any:
    """An Executor as it is; for a dask.distributed.Client, its wrt.renderer.distributed.dask.Submitter."""
    if not hasattr(executor, "get_executor"):
        return executor
    from wrt.renderer.distributed.dask import Submitter

    return Submitter(executor)


def result(pool: Any, future: Any) -> Any:
    """Of a future of the submitter. Raises what the worker raised, and InputError where it will never come."""
    try:
        return future.result()
    except CancelledError as error:
        raise (pool.lost() if hasattr(pool, "lost") else InputError("the executor has cancelled the work")) from error
    except BrokenExecutor as error:
        raise InputError(f"executor: {error}") from error


def cancel(pool: Any, futures: Iterable[Any]) -> None:
    """Those of the submitter that have not begun will not."""
    if hasattr(pool, "cancel"):
        pool.cancel(futures)
        return
    for future in futures:
        future.cancel()


def by_mesh(run: Callable[..., list[Any]], plan: Any, report: Callable[[Any], None], executor: Any = None) -> list[Any]:
    """The rows of run(plan, report), where plan.meshes are measured each by one worker, which reads the file under the same
    path; without an executor, here, one after another.

    report gets the rows of a mesh together, meshes in their order. Raises InputError where there are no meshes.
    """
    if executor is None:
        return run(plan, report)
    if not plan.meshes:
        raise InputError("a cluster measures meshes, each on one worker: name some")
    pool, rows = submitter(executor), []
    futures = [pool.submit(one_at_a_time, DIGEST, run, replace(plan, meshes=(where,))) for where in map(_found, plan.meshes)]
    try:
        for future in futures:
            part = result(pool, future)
            for row in part:
                report(row)
            rows += part
    finally:
        cancel(pool, futures)
    return rows


def _found(mesh: Mesh | str | Path) -> Mesh | str:
    return mesh if isinstance(mesh, Mesh) else os.path.abspath(mesh)


def one_at_a_time(digest: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """On a worker: two that are timed at once in a process would each slow the other down, and kernels are not made for two
    threads at once. Raises InputError where the DIGEST of who asks is another."""
    if digest != DIGEST:
        raise InputError(f"worker {worker_name()} has other code of wrt, another Python, NumPy or Warp: all must have the same")
    with _alone:
        return function(*arguments)
