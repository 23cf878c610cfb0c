"""Dask workers, on one machine or on many: how a scheduler is found, and how its workers trace tiles.

Tasks that ran on a worker that died are run again by the scheduler; the scene is scattered once, and again where it died with
all that held it. Nothing is imported from Dask before somebody asks for it.
"""

from __future__ import annotations

import logging
import pkgutil
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any

import warp as wp

import wrt
from wrt.crews import Job, Reply, Workers, call
from wrt.errors import InputError

CONNECT_SECONDS = 10.0  # to find the scheduler
WORKER_SECONDS = 10.0  # for a first worker to come
PATIENCE = 60.0  # seconds without any worker, in a render
# What must be the same everywhere, as pkgutil.resolve_name finds it: a worker without wrt can be asked too.
VERSIONS = {"wrt:__version__": wrt.__version__, "warp:__version__": wp.__version__}


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A Client of the scheduler at that address (tcp://host:8786). Raises InputError where nobody answers, there is no
    worker, or one cannot render for us."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed: pip install 'wrt[cluster]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong is told in our words
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"no Dask scheduler at {address!r}: {error}") from error
    with client:
        check_workers(client)
        yield client


def check_workers(client: Any) -> None:
    """Raises InputError where there are no workers, or one of them has no wrt, or another version of it."""
    if client.asynchronous:
        raise InputError("the Client is asynchronous: make one without asynchronous=True")
    where = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise InputError(f"no worker at {where}: start some with `dask worker {where}`") from error
    for name, version in VERSIONS.items():
        package = name.partition(":")[0]
        for worker, found in client.run(pkgutil.resolve_name, name, on_error="return").items():
            if isinstance(found, BaseException):
                raise InputError(f"worker {worker} has no {package} ({found}): wrt {wrt.__version__} must be installed there")
            if found != version:
                raise InputError(f"worker {worker} has {package} {found}; here it is {version}, and all must have the same")


class ClusterWorkers(Workers):
    """The workers of a dask.distributed.Client."""

    def __init__(self, client: Any, key: str, package: dict[str, Any]) -> None:
        check_workers(client)
        super().__init__(client.get_executor(pure=False), key, package)
        self.client = client
        self.scattered: Any = None
        self.alone_since: float | None = None

    def slots(self) -> int:
        return max(1, sum(self.client.nthreads().values()))

    def _scene(self) -> Any:
        return self.scattered

    def ready(self) -> bool:
        """Whether the scene is where the workers are, if one asked for it."""
        if not self.asked or (self.scattered is not None and self.scattered.status in ("pending", "finished")):
            return True
        now = time.monotonic()
        try:
            if self.client.nthreads():
                # A list of one: a dict by itself would be a dict of futures.
                self.scattered = self.client.scatter([self.package], broadcast=True, hash=False)[0]
                self.alone_since = None
                return True
        except (OSError, CancelledError) as error:
            raise self._lost() from error
        self.alone_since = self.alone_since or now
        if now - self.alone_since > PATIENCE:
            raise InputError(f"no worker is left at {self.client.scheduler.address}")
        return False

    def submit(self, job: Job) -> Future[Any]:
        return self.executor.submit(call, self.key, self._scene(), *job)

    def result(self, future: Future[Any]) -> Reply | None:
        from distributed import KilledWorker

        try:
            return super().result(future)
        except CancelledError as error:  # what it needed died with its worker, or the scheduler did
            if self.client.status != "running":
                raise self._lost() from error
            return None
        except KilledWorker as error:
            raise InputError(f"one tile after another worker died: {error}") from error

    def _lost(self) -> InputError:
        return InputError("the connection to the Dask scheduler is lost")
