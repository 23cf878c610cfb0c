"""Measurements on the workers of an executor.

Times are comparable only within one worker. So one worker measures everything that is compared on a mesh."""

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


def submitter(executor: object) -> "Executor | Submitter":
    """Return the executor itself, or a Submitter if it is a dask.distributed.Client."""
    if not hasattr(executor, "get_executor"):
        return cast(Executor, executor)
    from wrt.renderer.distributed.dask import Submitter

    return Submitter(executor)


def result(pool: "Executor | Submitter", future: Future[T]) -> T:
    """Return the result of a future. Raise the worker's error, or InputError if the work was cancelled or the executor broke."""
    try:
        return future.result()
    except CancelledError as error:
        raise (pool.lost() if hasattr(pool, "lost") else InputError("cancelled the work", argument="executor")) from error
    except BrokenExecutor as error:
        raise InputError(str(error), argument="executor") from error


def cancel(pool: "Executor | Submitter", futures: Iterable[Future[T]]) -> None:
    """Cancel the futures that have not begun."""
    if hasattr(pool, "cancel"):
        pool.cancel(futures)
    else:
        for future in futures:
            future.cancel()


def by_mesh(run: Callable[..., list[T]], plan: Any, report: Callable[[T], None], executor: object = None) -> list[T]:
    """Return the rows of run(plan, report). With an executor, one worker measures each mesh; it reads a mesh file at the caller's path.
    `report` receives the rows in the order of the meshes. Raise InputError if a plan for an executor has no meshes."""
    if executor is None:
        return run(plan, report)
    if not plan.meshes:
        raise InputError("must be given for a cluster, where each mesh is measured by one worker", argument="meshes")
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
    """Call a function on a worker, one call at a time in a process, because concurrent timings slow each other down.
    Raise InputError unless `digest` is the worker's DIGEST, computed from its versions of wrt, Python, NumPy and Warp."""
    if digest != DIGEST:
        raise InputError(f"worker {worker_name()} has another version of wrt, Python, NumPy or Warp; all workers need the same versions")
    with _alone:
        return function(*arguments)
