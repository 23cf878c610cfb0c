"""Dask workers on one or several machines: connection to a scheduler, and tiles as tasks.

The scheduler repeats the tasks of a worker that died. The scene is scattered to the workers once, and again if all workers that had it
died. Dask is imported at first use.
"""

import asyncio
import logging
import pkgutil
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future
from concurrent.futures import wait as wait_here
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, cast

from wrt.core.errors import InputError
from wrt.core.version import VERSION
from wrt.renderer.distributed.installed import INSTALLED, SAME_EVERYWHERE, difference
from wrt.renderer.distributed.workers import ExecutorWorkers, Package, Reply, ReplyFuture

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS = 5.0  # time limit for reaching the scheduler
WORKER_SECONDS = 10.0  # time limit for the first worker to connect
RESULT_SECONDS = 30.0  # time limit for fetching results from workers
PATIENCE = 60.0  # seconds without any worker after which a render fails


@contextmanager
def connected(address: str) -> "Iterator[Client]":
    """Yield a dask.distributed.Client of the scheduler at an address such as tcp://host:8786.

    Raises InputError if the scheduler does not answer or has no worker, or if a worker has a different installation."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed", hint="pip install 'wrt[cluster]'") from None
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # InputError reports the errors
    try:
        kind = asyncio.run(asyncio.wait_for(_identity(address), CONNECT_SECONDS))
        if kind != "Scheduler":
            raise ValueError(f"a {kind} answers")
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except TimeoutError as error:
        raise InputError(f"no Dask scheduler at {address!r}: no answer in {CONNECT_SECONDS:g} s") from error
    except Exception as error:  # if another program answers, the error can have any type
        raise InputError(f"no Dask scheduler at {address!r}: {error}") from error
    with client:
        check_workers(client)
        yield client


async def _identity(address: str) -> str:
    """Return the type of the Dask server at an address. Used before Client, which would wait forever for a silent server."""
    from distributed.core import rpc
    from distributed.security import Security

    how = Security().get_connection_args("client")  # from Dask's configuration, like a Client
    async with rpc(address, timeout=CONNECT_SECONDS, connection_args=how) as there:
        return str((await there.identity())["type"])


def check_workers(client: "Client") -> None:
    """Raise InputError if there is no worker, or if a worker lacks wrt or has a different installation than this process."""
    if client.asynchronous:
        raise InputError("is an asynchronous Client", argument="executor", hint="make one without asynchronous=True")
    where = client.scheduler.address  # type: ignore[union-attr]
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise InputError(f"no worker at {where}", hint=f"start some with `dask worker {where}`") from error
    # Workers without wrt can run `resolve_name`, and every version of wrt has `__version__`.
    for name in ("wrt:__version__", "wrt.renderer.distributed.installed:INSTALLED"):
        for worker, found in client.run(pkgutil.resolve_name, name, on_error="return").items():
            if isinstance(found, BaseException):
                raise InputError(f"worker {worker} lacks this version of wrt ({found})", hint=f"install wrt {VERSION} on the worker")
            if isinstance(found, str) and found != VERSION:
                raise InputError(f"worker {worker} has wrt {found} (here {VERSION})", hint=SAME_EVERYWHERE)
            if isinstance(found, dict) and (differs := difference(INSTALLED, found)):
                raise InputError(f"worker {worker} has {differs}", hint=SAME_EVERYWHERE)


class Submitter:
    """A dask.distributed.Client with the methods of an Executor that ClusterWorkers needs."""

    def __init__(self, client: object) -> None:
        self.client = cast(Any, client)
        check_workers(self.client)
        self.address = str(self.client.scheduler.address)

    def submit(self, function: Callable[..., object], *arguments: object) -> ReplyFuture:
        with self.guarded():
            return self.client.submit(function, *arguments, pure=False)

    def cancel(self, futures: Iterable[ReplyFuture]) -> None:
        if self.client.status == "running":
            with suppress(Exception):  # the connection may be lost, together with the futures
                self.client.cancel(list(futures))

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Raise one error, from `lost`, in place of the various errors that a broken connection causes in the `with` block."""
        try:
            yield
        except Exception as error:
            if self.is_broken(error):
                raise self.lost() from error
            raise

    def is_broken(self, error: Exception) -> bool:
        """Return True if the error comes from a broken connection."""
        return isinstance(error, OSError | CancelledError) or self.client.status != "running"

    def lost(self) -> InputError:
        return InputError("the connection to the Dask scheduler is lost", path=self.address)


class ClusterWorkers(ExecutorWorkers):
    """The workers of a dask.distributed.Client."""

    def __init__(self, client: object, key: str, package: Package) -> None:
        self.submitter = Submitter(client)
        super().__init__(self.submitter, key, package)
        self.client, self.address = self.submitter.client, self.submitter.address
        self.scattered: Any = None
        self.fetches: dict[Future[list[Any]], list[ReplyFuture]] = {}  # transfers of replies, and the futures of the replies
        self.fetched: dict[str, Reply | None] = {}
        self.has_workers, self.next_look = True, 0.0
        self.alone_since: float | None = None

    def slots(self) -> int:
        with self.submitter.guarded():
            return max(1, sum(self.client.nthreads().values()))

    def _scene(self) -> Any:
        return self.scattered

    def ready(self) -> bool:
        """Return True if there are workers. If a worker requested the scene, the scene must also be on its way to the workers."""
        if self.client.status not in ("running", "connecting"):
            raise self.submitter.lost()
        try:
            if self.client.status == "running" and self._send_scene():
                self.alone_since = None
                return True
        except Exception as error:
            if not self.submitter.is_broken(error):
                raise
        self.alone_since = self.alone_since or time.monotonic()
        if time.monotonic() - self.alone_since > PATIENCE:
            raise InputError("no worker is left", path=self.address)
        return False

    def _send_scene(self) -> bool:
        """Scatter the scene if a worker requested it. Return False if there is no worker, or if scattering fails."""
        sent = not self.requests or (self.scattered is not None and self.scattered.status in ("pending", "finished"))
        if not sent or time.monotonic() >= self.next_look:
            self.has_workers, self.next_look = bool(self.client.nthreads()), time.monotonic() + 1.0
        if sent or not self.has_workers:
            return self.has_workers
        with suppress(TimeoutError):  # the last worker is gone
            # The package is in a list, because Dask would scatter the values of a dict one by one.
            self.scattered = self.client.scatter([self.package], broadcast=True, hash=False)[0]
            return True
        return False

    def cancel(self, futures: Iterable[ReplyFuture]) -> None:
        for fetch in self.fetches:
            fetch.cancel()
        self.fetches.clear()
        self.submitter.cancel(futures)

    def finished(self, pending: Iterable[ReplyFuture]) -> Iterable[ReplyFuture]:
        from distributed import wait

        coming = {future.key for futures in self.fetches.values() for future in futures}
        waiting = [future for future in pending if future.key not in coming]
        self.ready()
        if self.fetches:
            wait_here(self.fetches, timeout=0.1, return_when=FIRST_COMPLETED)
        elif waiting:
            with self.submitter.guarded(), suppress(TimeoutError, CancelledError), self.client.as_current():
                wait(waiting, timeout=0.1, return_when="FIRST_COMPLETED")
        else:
            time.sleep(0.1)
        done = [future for future in waiting if future.status not in ("pending", "finished")]
        computed = [future for future in waiting if future.status == "finished"]
        if computed:
            self.fetches[asyncio.run_coroutine_threadsafe(self._fetch(computed), self.client.loop.asyncio_loop)] = computed
        for fetch in [fetch for fetch in self.fetches if fetch.done()]:
            futures = self.fetches.pop(fetch)
            with self.submitter.guarded(), suppress(TimeoutError, CancelledError):
                replies = fetch.result()
                if len(replies) == len(futures):  # otherwise a worker died before sending its replies
                    self.fetched |= {future.key: reply for future, reply in zip(futures, replies, strict=True)}
            done += futures
        return done

    async def _fetch(self, futures: list[Any]) -> list[Any]:
        """Fetch the replies of several futures in one call, in RESULT_SECONDS at most."""
        return await asyncio.wait_for(self.client.gather(futures, errors="skip", asynchronous=True), RESULT_SECONDS)

    def result(self, future: ReplyFuture) -> Reply | None:
        from distributed import KilledWorker

        if future.key in self.fetched:
            reply = self.fetched.pop(future.key)
            self.requests += reply is None
            return reply
        try:
            if future.status == "error":
                future.result(timeout=RESULT_SECONDS)
        except KilledWorker as error:
            raise InputError(f"tiles kill their workers, one after another: {error}", path=self.address) from error
        except (CancelledError, TimeoutError):
            pass
        return None  # the input or the result was lost when a worker died
