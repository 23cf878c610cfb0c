"""Dask workers, on one machine or on many: how a scheduler is found, and how its workers trace tiles.

Tasks that ran on a worker that died are run again by the scheduler; the scene is scattered once, and again where it died with
all that held it. Nothing is imported from Dask before somebody asks for it.
"""

from __future__ import annotations

import asyncio
import logging
import pkgutil
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future
from concurrent.futures import wait as wait_here
from contextlib import contextmanager, suppress
from typing import Any

from wrt.core.device import describe_devices
from wrt.core.errors import InputError
from wrt.core.version import VERSION
from wrt.renderer.distributed.installed import INSTALLED, difference
from wrt.renderer.distributed.workers import ExecutorWorkers, Reply

CONNECT_SECONDS = 5.0  # to find the scheduler
WORKER_SECONDS = 10.0  # for a first worker to come
RESULT_SECONDS = 30.0  # to fetch what a worker made
PATIENCE = 60.0  # seconds without any worker, in a render


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """A Client of the scheduler at that address (tcp://host:8786). Raises InputError where nobody answers, there is no
    worker, or one cannot render for us."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed", hint="pip install 'wrt[cluster]'") from None
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what goes wrong is reported in our words
    try:
        kind = asyncio.run(asyncio.wait_for(_identity(address), CONNECT_SECONDS))
        if kind != "Scheduler":
            raise ValueError(f"a {kind} answers")
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except TimeoutError as error:
        raise InputError(f"no Dask scheduler at {address!r}: no answer in {CONNECT_SECONDS:g} s") from error
    except Exception as error:  # of any kind, where something else answers
        raise InputError(f"no Dask scheduler at {address!r}: {error}") from error
    with client:
        check_workers(client)
        yield client


async def _identity(address: str) -> str:
    """Who answers there. A Client by itself waits for ever for one that takes the connection and says nothing."""
    from distributed.core import rpc
    from distributed.security import Security

    how = Security().get_connection_args("client")  # as Dask's configuration has it, and a Client too
    async with rpc(address, timeout=CONNECT_SECONDS, connection_args=how) as there:
        return str((await there.identity())["type"])


def check_workers(client: Any) -> None:
    """Raises InputError where there are no workers, or one of them has no wrt, or not the same as here."""
    if client.asynchronous:
        raise InputError("is an asynchronous Client", argument="executor", hint="make one without asynchronous=True")
    where = client.scheduler.address
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise InputError(f"no worker at {where}", hint=f"start some with `dask worker {where}`") from error
    # A function that workers without wrt have too, and before what is compared, what every version of wrt has.
    for name in ("wrt:__version__", "wrt.renderer.distributed.installed:INSTALLED"):
        for worker, found in client.run(pkgutil.resolve_name, name, on_error="return").items():
            if isinstance(found, BaseException):
                raise InputError(f"worker {worker} has no such wrt ({found}): wrt {VERSION} must be installed there")
            if isinstance(found, str) and found != VERSION:
                raise InputError(f"worker {worker} has wrt {found} (here {VERSION}): all must have the same")
            if isinstance(found, dict) and (differs := difference(INSTALLED, found)):
                raise InputError(f"worker {worker} has {differs}: all must have the same")


def machines(client: Any) -> str:
    """What the workers run on, as far as it differs."""
    devices = [lines[0] for lines in client.run(describe_devices).values()]
    return "; ".join(f"{devices.count(line)} workers of {line}" for line in dict.fromkeys(devices))


class Submitter:
    """A dask.distributed.Client with the little of an Executor that a sweep takes: its own futures know of every end there is."""

    def __init__(self, client: Any) -> None:
        check_workers(client)
        self.client, self.address = client, str(client.scheduler.address)

    def submit(self, function: Any, *arguments: Any) -> Any:
        with self.guarded():
            return self.client.submit(function, *arguments, pure=False)

    def cancel(self, futures: Iterable[Any]) -> None:
        if self.client.status == "running":
            with suppress(Exception):  # it may be lost meanwhile, and then there is nothing to cancel
                self.client.cancel(list(futures))

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """A connection that breaks shows in errors of many kinds: all of them are `lost`."""
        try:
            yield
        except Exception as error:
            if self.is_broken(error):
                raise self.lost() from error
            raise

    def is_broken(self, error: Exception) -> bool:
        """Whether this error came of a broken connection."""
        return isinstance(error, OSError | CancelledError) or self.client.status != "running"

    def lost(self) -> InputError:
        return InputError("the connection to the Dask scheduler is lost", path=self.address)


class ClusterWorkers(ExecutorWorkers):
    """The workers of a dask.distributed.Client."""

    def __init__(self, client: Any, key: str, package: dict[str, Any]) -> None:
        self.submitter = Submitter(client)
        super().__init__(self.submitter, key, package)
        self.client, self.address = client, self.submitter.address
        self.scattered: Any = None
        self.fetches: dict[Future[list[Any]], list[Any]] = {}  # replies that are on their way, and what they are the results of
        self.fetched: dict[str, Reply | None] = {}
        self.anybody, self.ask_again = True, 0.0
        self.alone_since: float | None = None

    def slots(self) -> int:
        with self.submitter.guarded():
            return max(1, sum(self.client.nthreads().values()))

    def _scene(self) -> Any:
        return self.scattered

    def ready(self) -> bool:
        """Whether there are workers, and the scene is where they are, if one asked for it."""
        if self.client.status not in ("running", "connecting"):
            raise self.submitter.lost()
        try:
            if self.client.status == "running" and self._is_sent():
                self.alone_since = None
                return True
        except Exception as error:
            if not self.submitter.is_broken(error):
                raise
        self.alone_since = self.alone_since or time.monotonic()
        if time.monotonic() - self.alone_since > PATIENCE:
            raise InputError("no worker is left", path=self.address)
        return False

    def _is_sent(self) -> bool:
        sent = not self.asked or (self.scattered is not None and self.scattered.status in ("pending", "finished"))
        if not sent or time.monotonic() >= self.ask_again:
            self.anybody, self.ask_again = bool(self.client.nthreads()), time.monotonic() + 1.0
        if sent or not self.anybody:
            return self.anybody
        with suppress(TimeoutError):  # the last worker went away meanwhile
            # A list of one: a dict by itself would be a dict of futures.
            self.scattered = self.client.scatter([self.package], broadcast=True, hash=False)[0]
            return True
        return False

    def cancel(self, futures: Iterable[Any]) -> None:
        for fetch in self.fetches:
            fetch.cancel()
        self.fetches.clear()
        self.submitter.cancel(futures)

    def finished(self, pending: Iterable[Any]) -> Iterable[Any]:
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
                if len(replies) == len(futures):  # else a worker died before it gave its own away
                    self.fetched |= {future.key: reply for future, reply in zip(futures, replies, strict=True)}
            done += futures
        return done

    async def _fetch(self, futures: list[Any]) -> list[Any]:
        """Replies, all in one call, which a worker that hangs makes a long one."""
        return await asyncio.wait_for(self.client.gather(futures, errors="skip", asynchronous=True), RESULT_SECONDS)

    def result(self, future: Any) -> Reply | None:
        from distributed import KilledWorker

        if future.key in self.fetched:
            reply = self.fetched.pop(future.key)
            self.asked += reply is None
            return reply
        try:
            if future.status == "error":
                future.result(timeout=RESULT_SECONDS)
        except KilledWorker as error:
            raise InputError(f"tiles kill their workers, one after another: {error}", path=self.address) from error
        except (CancelledError, TimeoutError):
            pass
        return None  # what it needed, or made, died with its worker
