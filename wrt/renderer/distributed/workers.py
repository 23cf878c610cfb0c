"""Workers of a distributed render: the devices of this machine, or the workers of an executor.

A tile is a pure function of the scene, the samples to trace and the tile's previous state (Prepared.trace_tile). Any worker can compute
it, also again after another worker died. A worker process prepares a scene once, and caches it under the scene's digest.
"""

import os
import socket
import threading
import time
import warnings
from collections import OrderedDict, deque
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, wait
from dataclasses import replace
from hashlib import sha256
from queue import SimpleQueue
from typing import Any

from wrt.core.device import start
from wrt.core.errors import InputError, SceneWarning
from wrt.core.threads import Pool
from wrt.renderer.distributed.installed import INSTALLED, SAME_EVERYWHERE, difference
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import Prepared, kind_of, prepare
from wrt.scene.digest import digest
from wrt.scene.model import Scene
from wrt.scene.pack import pack, unpack

QUEUED = 3  # Submitted jobs for each slot, so that no worker is idle.
SLOTS = 32  # Assumed number of slots of an executor that does not state it.
DEAD_SECONDS = 5.0  # Seconds without a reply after the death of a process, until it is an error.
CACHED = 2  # Largest number of prepared scenes in a worker process.
OPTIONS_SENT = ("device", "accel", "aov", "target_error", "triangle", "box", "instancing", "accel_options")
LOCAL: dict[str, Any] = {"executor": None, "devices": None, "checkpoint": None, "resume": False, "progress": None}

Job = tuple[Any, ...]  # The name of a method of Prepared, and its arguments.
Reply = tuple[str, str, Any]  # The worker's name, the kind of its device (kind_of), and the result of the method.
Package = dict[str, Any]  # A scene and its options in plain values and arrays (`packaged`).
ReplyFuture = Any  # A Future of concurrent.futures or dask.distributed; its result is a Reply or None.


class ExecutorWorkers:
    """The workers of any concurrent.futures.Executor: threads, processes, or other machines with wrt.

    A job contains the digest of its scene. If a worker process lacks that scene, it replies None, which requests the scene."""

    def __init__(self, executor: Any, key: str, package: Package) -> None:
        self.executor, self.key, self.package = executor, key, package
        self.requests = 0  # number of open requests for the scene
        self.dead_since: float | None = None

    def slots(self) -> int:
        """Return the number of jobs that can run at once."""
        return int(getattr(self.executor, "_max_workers", None) or SLOTS)

    def _scene(self) -> Any:
        """Return the package to send with the next job, or None if no worker has requested it."""
        if not self.requests:
            return None
        self.requests -= 1
        return self.package

    def submit(self, job: Job) -> ReplyFuture:
        try:
            return self.executor.submit(call, self.key, self._scene(), *job)
        except (BrokenExecutor, RuntimeError) as error:
            raise InputError(str(error), argument="executor") from error

    def finished(self, pending: Iterable[ReplyFuture]) -> Iterable[ReplyFuture]:
        """Wait a tenth of a second at most, and return the futures that are done."""
        done = wait(pending, timeout=0.1, return_when=FIRST_COMPLETED).done
        processes = dict(getattr(self.executor, "_processes", None) or {})
        if done or all(process.is_alive() for process in processes.values()):
            self.dead_since = None
        elif self.dead_since is None:
            self.dead_since = time.monotonic()
        elif time.monotonic() - self.dead_since > DEAD_SECONDS:
            # The process was killed while it wrote a reply, and the pool would wait forever for the rest of the reply.
            raise InputError("a process of the pool was killed", argument="executor")
        return done

    def result(self, future: ReplyFuture) -> Reply | None:
        """Return the reply of a finished future; None: the worker lacks the scene. Raises the worker's exception."""
        try:
            reply = future.result()
        except BrokenExecutor as error:
            raise InputError(str(error), argument="executor") from error
        self.requests += reply is None
        return reply

    def ready(self) -> bool:
        """Return True if a job can be submitted now. Raises InputError if the workers are gone for good."""
        return True

    def run(self, jobs: Iterable[Job]) -> Generator[tuple[Job, Reply] | None, None, None]:
        """Run jobs. Yield each job with its reply, in any order. While no reply comes, yield None every tenth of a second.

        A job is taken from `jobs` just before it is submitted. When the caller closes the generator, waiting jobs are cancelled."""
        coming, again = iter(jobs), deque[Job]()
        pending: dict[ReplyFuture, Job] = {}
        limit, done = QUEUED * self.slots(), False
        try:
            while pending or again or not done:
                while len(pending) < limit and self.ready():
                    job = again.popleft() if again else next(coming, None)
                    if job is None:
                        done = True
                        break
                    pending[self.submit(job)] = job
                finished = self.finished(pending)
                for future in finished:
                    job, reply = pending.pop(future), self.result(future)
                    if reply is None:
                        again.append(job)
                    else:
                        yield job, reply
                if not finished:
                    yield None
        finally:
            self.cancel(pending)

    def cancel(self, futures: Iterable[ReplyFuture]) -> None:
        """Cancel the futures whose jobs have not begun."""
        for future in futures:
            future.cancel()


class DeviceWorkers(ExecutorWorkers):
    """Several devices of this machine. Each device has a thread, which prepares the scene and runs jobs."""

    def __init__(self, scene: Scene, options: Options) -> None:
        assert options.devices is not None
        super().__init__(Pool(len(options.devices)), "", {})
        self.scene, self.options, self.names = scene, replace(options, **LOCAL), options.devices
        self.free: SimpleQueue[tuple[int, Prepared | None]] = SimpleQueue()  # one entry for each thread
        for i in range(len(self.names)):
            self.free.put((i, None))
        self.lock = threading.Lock()

    def submit(self, job: Job) -> ReplyFuture:
        return self.executor.submit(self._call, *job)

    def _call(self, method: str, *arguments: Any) -> Reply:
        i, prepared = self.free.get()
        try:
            if prepared is None:
                with self.lock:  # the first device of a kind compiles the kernels for all devices of that kind
                    prepared = _prepared(self.scene, replace(self.options, device=self.names[i]))
            return f"{self.names[i]} ({i})", kind_of(prepared.device), getattr(prepared, method)(*arguments)
        finally:
            self.free.put((i, prepared))


# --- packages, and functions that workers run -------------------------------------------------------------------------


def packaged(scene: Scene, options: Options, kernels: str) -> tuple[str, Package]:
    """Return a digest of the scene and its options (equal digests mean equal pixels), and the package for workers.

    kernels: hash of the kernels. A worker whose kernels have another hash refuses the package."""
    text, arrays = pack(scene)
    package = {"installed": INSTALLED, "kernels": kernels, "options": {name: getattr(options, name) for name in OPTIONS_SENT},
               "scene": text}
    key = sha256(f"{package}{digest(scene)}".encode()).hexdigest()
    return key, {**package, "arrays": arrays}


_ready: OrderedDict[str, Prepared] = OrderedDict()
_lock = threading.Lock()


def call(key: str, package: Package | None, method: str, *arguments: object) -> Reply | None:
    """Call a method of the prepared scene (Prepared) that this worker caches under `key`, after preparing it from `package` if needed.

    Returns None if the cache lacks the scene and `package` is None. Raises InputError if the caller has a different installation."""
    with _lock:
        if key not in _ready:
            if package is None:
                return None
            _ready[key] = _unpacked(package)
        _ready.move_to_end(key)
        while len(_ready) > CACHED:
            _ready.popitem(last=False)
        prepared = _ready[key]
    return worker_name(), kind_of(prepared.device), getattr(prepared, method)(*arguments)


def _unpacked(package: Package) -> Prepared:
    if differs := difference(package["installed"], INSTALLED):
        raise InputError(f"worker {worker_name()} has {differs}", hint=SAME_EVERYWHERE)
    prepared = _prepared(unpack(package["scene"], package["arrays"]), Options(**package["options"]))
    if prepared.plan.kernels_hash() != package["kernels"]:
        raise InputError(f"worker {worker_name()} generates other kernels from the same code", hint="install the same warp-lang everywhere")
    return prepared


def _prepared(scene: Scene, options: Options) -> Prepared:
    plan, device = plan_of(scene, options), start(options.device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # the caller reports the warnings
        return prepare(plan, device)


def worker_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"
