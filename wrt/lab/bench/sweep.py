"""Sweeps on the workers of an executor.

Counts may come from any worker. Times compare within a worker, so one worker measures a whole case: a mesh with all that is compared on
it."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

from wrt.core.errors import InputError
from wrt.renderer.distributed.installed import DIGEST
from wrt.renderer.distributed.workers import worker_name
from wrt.scene.mesh import Mesh

if TYPE_CHECKING:
    from wrt.renderer.distributed.dask import Submitter

T = TypeVar("T")
_alone = threading.Lock()


def submitter(executor: object) -> Executor | Submitter:
    """Return an Executor as it is, and a Submitter for a dask.distributed.Client."""
    if not hasattr(executor, "get_executor"):
        return cast(Executor, executor)
    from wrt.renderer.distributed.dask import Submitter

    return Submitter(executor)


def result(pool: Executor | Submitter, future: Future[T]) -> T:
    """Return the result of a future. Raise the worker's error, or InputError if the result will never come."""
    try:
        return future.result()
    except CancelledError as error:
        raise (pool.lost() if hasattr(pool, "lost") else InputError("has cancelled the work", argument="executor")) from error
    except BrokenExecutor as error:
        raise InputError(str(error), argument="executor") from error


def cancel(pool: Executor | Submitter, futures: Iterable[Future[T]]) -> None:
    """Cancel the futures that have not begun."""
    if hasattr(pool, "cancel"):
        pool.cancel(futures)
    else:
        for future in futures:
            future.cancel()


def by_mesh(run: Callable[..., list[T]], plan: Any, report: Callable[[T], None], executor: object = None) -> list[T]:
    """Return the rows of run(plan, report), each mesh measured by one worker, or all of them here without an executor.
    A worker reads a file at the same path. `report` gets the rows of a mesh together, meshes in their order. Raise InputError if the plan
    has no meshes."""
    if executor is None:
        return run(plan, report)
    if not plan.meshes:
        raise InputError("must be given: a cluster measures each mesh on one worker", argument="meshes")
    pool, rows = submitter(executor), []
    meshes = [mesh if isinstance(mesh, Mesh) else os.path.abspath(mesh) for mesh in plan.meshes]
    futures = [pool.submit(one_at_a_time, DIGEST, run, replace(plan, meshes=(mesh,))) for mesh in meshes]
    try:
        for future in futures:
            part = result(pool, future)
            for row in part:
                report(row)
            rows += part
    finally:
        cancel(pool, futures)
    return rows


def one_at_a_time(digest: str, function: Callable[..., T], *arguments: object) -> T:
    """Call a function on a worker, one at a time in a process: concurrent timings slow each other down.
    Raise InputError if the worker's code has another digest."""
    if digest != DIGEST:
        raise InputError(f"worker {worker_name()} has other code of wrt, another Python, NumPy or Warp: all must have the same")
    with _alone:
        return function(*arguments)
