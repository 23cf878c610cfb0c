"""Workers of a distributed render: the devices of this machine, or the workers of an executor.

A tile is a pure function of the scene, the samples to take and its previous state (Prepared.trace_tile). Any worker can compute it, and
repeat it after another has died. A worker process prepares a scene once, and caches it under its digest.
"""

from __future__ import annotations

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
from wrt.renderer.distributed.installed import INSTALLED, difference
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of
from wrt.renderer.prepare import Prepared, kind_of, prepare
from wrt.scene.digest import scene_digest
from wrt.scene.model import Scene
from wrt.scene.pack import pack, unpack

QUEUED = 3  # Submitted calls for each slot, so that no worker is idle.
SLOTS = 32  # Slots of an executor that does not know its number.
DEAD_SECONDS = 5.0  # Until the death of a process is an error.
CACHED = 2  # Prepared scenes of a worker process.
OPTIONS_SENT = ("device", "accel", "aov", "target_error", "triangle", "box", "instancing", "accel_options")
LOCAL: dict[str, Any] = {"executor": None, "devices": None, "checkpoint": None, "resume": False, "progress": None}

Job = tuple[Any, ...]  # The name of a method of Prepared, and its arguments.
Reply = tuple[str, str, Any]  # The worker's name, the kind of its device (kind_of), and the result of the method.
Package = dict[str, Any]  # A scene and its options in plain values and arrays (`packaged`).
ReplyFuture = Any  # A Future of concurrent.futures or dask.distributed; its result is a Reply or None.


class ExecutorWorkers:
    """The workers of any concurrent.futures.Executor: threads, processes, or other machines with wrt.

    A job has the digest of its scene; a worker process that does not know it requests the scene by the reply None.
    """

    def __init__(self, executor: Any, key: str, package: Package) -> None:
        self.executor, self.key, self.package = executor, key, package
        self.requests = 0  # for the scene
        self.dead_since: float | None = None

    def slots(self) -> int:
        """Return the number of jobs that can run at once."""
        return int(getattr(self.executor, "_max_workers", None) or SLOTS)

    def _scene(self) -> Any:
        if not self.requests:
            return None
        self.requests -= 1
        return self.package

    def submit(self, job: Job) -> ReplyFuture:
        """Submit a job."""
        try:
            return self.executor.submit(call, self.key, self._scene(), *job)
        except (BrokenExecutor, RuntimeError) as error:
            raise InputError(str(error), argument="executor") from error

    def finished(self, pending: Iterable[ReplyFuture]) -> Iterable[ReplyFuture]:
        """Return futures that are done; wait a tenth of a second at most."""
        done = wait(pending, timeout=0.1, return_when=FIRST_COMPLETED).done
        processes = dict(getattr(self.executor, "_processes", None) or {})
        if done or all(process.is_alive() for process in processes.values()):
            self.dead_since = None
        elif self.dead_since is None:
            self.dead_since = time.monotonic()
        elif time.monotonic() - self.dead_since > DEAD_SECONDS:
            # Killed while it wrote a reply: the pool would wait for the rest forever.
            raise InputError("a process of the pool was killed", argument="executor")
        return done

    def result(self, future: ReplyFuture) -> Reply | None:
        """Return the reply of a finished future; None: its job must be submitted again. Raises the exception of the worker."""
        try:
            reply = future.result()
        except BrokenExecutor as error:
            raise InputError(str(error), argument="executor") from error
        self.requests += reply is None
        return reply

    def ready(self) -> bool:
        """Return True if there are workers for jobs. Raises InputError if that will not change."""
        return True

    def run(self, jobs: Iterable[Job]) -> Generator[tuple[Job, Reply] | None, None, None]:
        """Run jobs, and yield each with its reply once it is done, in any order; None about every tenth of a second without a reply.

        Jobs are drawn from `jobs` shortly before they are submitted. When the caller closes the generator, waiting jobs are cancelled.
        """
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
        """Cancel futures that have not begun."""
        for future in futures:
            future.cancel()


class DeviceWorkers(ExecutorWorkers):
    """Several devices of this machine: a thread for each, which prepares the scene on its device."""

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
                with self.lock:  # so that the first device of a kind compiles for the others
                    prepared = _prepared(self.scene, replace(self.options, device=self.names[i]))
            return f"{self.names[i]} ({i})", kind_of(prepared.device), getattr(prepared, method)(*arguments)
        finally:
            self.free.put((i, prepared))


# --- what is sent, and the worker's side ------------------------------------------------------------------------------


def packaged(scene: Scene, options: Options, kernels: str) -> tuple[str, Package]:
    """Return the key of a scene with its options, equal for equal pixels, and the package for workers.

    kernels: hash of the kernels; a worker whose kernels have another hash refuses the package.
    """
    text, arrays = pack(scene)
    package = {"installed": INSTALLED, "kernels": kernels, "options": {name: getattr(options, name) for name in OPTIONS_SENT},
               "scene": text}
    key = sha256(f"{package}{scene_digest(scene)}".encode()).hexdigest()
    return key, {**package, "arrays": arrays}


_ready: OrderedDict[str, Prepared] = OrderedDict()
_lock = threading.Lock()


def call(key: str, package: Package | None, method: str, *arguments: object) -> Reply | None:
    """Call a method of the Prepared cached under `key`, on a worker; prepare it from `package` if it is missing.

    Returns None if it is missing and there is no package. Raises InputError if the installation differs from the caller's.
    """
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
        raise InputError(f"worker {worker_name()} has {differs}: all must have the same")
    prepared = _prepared(unpack(package["scene"], package["arrays"]), Options(**package["options"]))
    if prepared.plan.kernels_hash() != package["kernels"]:
        raise InputError(f"worker {worker_name()} makes other kernels of the same code", hint="install the same warp-lang everywhere")
    return prepared


def _prepared(scene: Scene, options: Options) -> Prepared:
    plan, device = plan_of(scene, options), start(options.device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # reported by the caller
        return prepare(plan, device)


def worker_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"
