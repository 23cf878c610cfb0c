"""Who traces the tiles of a distributed render: the devices of this machine, or the workers of an executor.

A tile is a pure function of the scene, its samples and what it had before (Prepared.trace_tile), so that it can be computed
anywhere, and again where a worker died over it. A worker process makes a scene ready once, and keeps it by its digest.
"""

from __future__ import annotations

import os
import socket
import threading
import time
import warnings
from collections import OrderedDict, deque
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
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

QUEUED = 3  # calls that wait or run, for each that can run at once, so that no worker waits for the next one
SLOTS = 32  # calls at once, of an executor that does not say how many
DEAD_SECONDS = 5.0  # of a process of a pool that has not noticed
KEPT_READY = 2  # scenes that a worker process keeps ready
OPTIONS_SENT = ("device", "accel", "aov", "target_error", "triangle", "box", "instancing", "accel_options")  # what workers need
LOCAL: dict[str, Any] = {"executor": None, "devices": None, "checkpoint": None, "resume": False, "progress": None}

Job = tuple[Any, ...]  # the name of a method of Prepared, and its arguments
Reply = tuple[str, str, Any]  # who answers, on what kind of device (kind_of), and what


class ExecutorWorkers:
    """The workers of any concurrent.futures.Executor: threads, processes, or those of other machines that have wrt.

    Jobs go with the scene's digest alone; a worker process that does not know it asks for the scene.
    """

    def __init__(self, executor: Any, key: str, package: dict[str, Any]) -> None:
        self.executor, self.key, self.package = executor, key, package
        self.asked = 0  # for the scene
        self.dead_since: float | None = None

    def slots(self) -> int:
        """How many jobs they can do at once."""
        return int(getattr(self.executor, "_max_workers", None) or SLOTS)

    def _scene(self) -> Any:
        if not self.asked:
            return None
        self.asked -= 1
        return self.package

    def submit(self, job: Job) -> Future[Any]:
        """A future of its reply."""
        try:
            return self.executor.submit(call, self.key, self._scene(), *job)
        except (BrokenExecutor, RuntimeError) as error:
            raise InputError(str(error), argument="executor") from error

    def finished(self, pending: Iterable[Any]) -> Iterable[Any]:
        """Futures that are done, after a tenth of a second or earlier."""
        done = wait(pending, timeout=0.1, return_when=FIRST_COMPLETED).done
        processes = dict(getattr(self.executor, "_processes", None) or {})
        if done or all(process.is_alive() for process in processes.values()):
            self.dead_since = None
        elif self.dead_since is None:
            self.dead_since = time.monotonic()
        elif time.monotonic() - self.dead_since > DEAD_SECONDS:
            # Killed in the middle of writing a reply: the pool waits for the rest of it, for ever.
            raise InputError("a process of the pool was killed", argument="executor")
        return done

    def result(self, future: Future[Any]) -> Reply | None:
        """What came of one that is done; None: its job must be submitted again. Raises what the worker raised."""
        try:
            reply = future.result()
        except BrokenExecutor as error:
            raise InputError(str(error), argument="executor") from error
        self.asked += reply is None
        return reply

    def ready(self) -> bool:
        """Whether anybody is there to take jobs. Raises InputError where that will not change."""
        return True

    def run(self, jobs: Iterable[Job]) -> Generator[tuple[Job, Reply] | None, None, None]:
        """Do the jobs, and give each with its reply as it is done, in any order; None every tenth of a second when none is. Jobs
        are drawn from `jobs` shortly before they are needed. What has not begun when the caller stops is cancelled."""
        coming, again = iter(jobs), deque[Job]()
        pending: dict[Any, Job] = {}
        room, done = QUEUED * self.slots(), False
        try:
            while pending or again or not done:
                while len(pending) < room and self.ready():
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

    def cancel(self, futures: Iterable[Any]) -> None:
        """Those that have not begun will not."""
        for future in futures:
            future.cancel()


class DeviceWorkers(ExecutorWorkers):
    """Several devices of this machine: a thread for each, which makes the scene ready on its device and keeps it."""

    def __init__(self, scene: Scene, options: Options) -> None:
        assert options.devices is not None
        super().__init__(Pool(len(options.devices)), "", {})
        self.scene, self.options, self.names = scene, replace(options, **LOCAL), options.devices
        self.free: SimpleQueue[tuple[int, Prepared | None]] = SimpleQueue()  # one is for every thread
        for i in range(len(self.names)):
            self.free.put((i, None))
        self.lock = threading.Lock()

    def submit(self, job: Job) -> Future[Any]:
        return self.executor.submit(self._call, *job)

    def _call(self, method: str, *arguments: Any) -> Reply:
        i, prepared = self.free.get()
        try:
            if prepared is None:
                with self.lock:  # the second device of a kind finds the kernels compiled
                    prepared = _made_ready(self.scene, replace(self.options, device=self.names[i]))
            return f"{self.names[i]} ({i})", kind_of(prepared.device), getattr(prepared, method)(*arguments)
        finally:
            self.free.put((i, prepared))



# --- what is sent, and the worker's side ------------------------------------------------------------------------------


def packaged(scene: Scene, options: Options, kernels: str) -> tuple[str, dict[str, Any]]:
    """A scene and how to render it, in plain values and arrays, and its key: the same for all that have the same pixels.

    kernels: their hash, which must be that of the workers' kernels.
    """
    text, arrays = pack(scene)
    package = {"installed": INSTALLED, "kernels": kernels, "options": {name: getattr(options, name) for name in OPTIONS_SENT},
               "scene": text}
    key = sha256(f"{package}{scene_digest(scene)}".encode()).hexdigest()
    return key, {**package, "arrays": arrays}


_ready: OrderedDict[str, Prepared] = OrderedDict()
_lock = threading.Lock()


def call(key: str, package: dict[str, Any] | None, method: str, *arguments: Any) -> Reply | None:
    """On a worker: a method of what is Prepared for that key, by the package where it is not yet; None: it is not, and there is no
    package. Raises InputError where what is installed here is not what asks."""
    with _lock:
        if key not in _ready:
            if package is None:
                return None
            _ready[key] = _unpacked(package)
        _ready.move_to_end(key)
        while len(_ready) > KEPT_READY:
            _ready.popitem(last=False)
        prepared = _ready[key]
    return worker_name(), kind_of(prepared.device), getattr(prepared, method)(*arguments)


def _unpacked(package: dict[str, Any]) -> Prepared:
    if differs := difference(package["installed"], INSTALLED):
        raise InputError(f"worker {worker_name()} has {differs}: all must have the same")
    prepared = _made_ready(unpack(package["scene"], package["arrays"]), Options(**package["options"]))
    if prepared.plan.kernels_hash() != package["kernels"]:
        raise InputError(f"worker {worker_name()} makes other kernels of the same code",
                         hint="install the same warp-lang everywhere")
    return prepared


def _made_ready(scene: Scene, options: Options) -> Prepared:
    plan, device = plan_of(scene, options), start(options.device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # reported where the render was asked for
        return prepare(plan, device)


def worker_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"
