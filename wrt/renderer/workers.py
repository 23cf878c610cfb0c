"""Renders that the workers of a Dask cluster share. The pixels have the bits of one device.

A tile is a pure function of the scene, the samples to trace and the tile's previous state (Prepared.trace_tile). Any worker can compute
it, also again after another worker died. A worker process prepares a scene once, and keeps it under a key. This process keeps the film
and controls passes, limits and checkpoints (wrt.renderer.schedule).
"""

import logging
import math
import os
import pickle
import pkgutil
import socket
import sys
import threading
import time
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp

from wrt.core import VERSION
from wrt.core.compiling import WATCH
from wrt.core.device import start
from wrt.core.errors import InputError, SceneWarning
from wrt.picture.film import Film
from wrt.renderer.checkpoint import checkpoint_of
from wrt.renderer.film import AovFilm, DeviceFilm, Rectangle, Work, tiles
from wrt.renderer.options import Options, Progress
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.prepare import Prepared, kind_of, prepare
from wrt.renderer.schedule import STEP_SECONDS, Facts, Run, Steps
from wrt.renderer.upload import warn_left_out
from wrt.scene.model import Scene, digest

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS = 5.0  # time limit for reaching the scheduler
WORKER_SECONDS = 10.0  # time limit for the first worker to connect
QUEUED = 3  # Submitted jobs for each slot, so that no worker is idle.
CACHED = 2  # Largest number of prepared scenes in a worker process.
TILES_EACH = 4  # Tiles of a pass for each slot.
SIDES = {"cpu": (32, 256), "cuda": (256, 1024)}  # limits of a tile's side: smaller tiles cost more to send, larger tiles take long
OPTIONS_SENT = ("device", "accel", "aov", "target_error", "triangle", "box", "instancing", "accel_options")

Job = tuple[Any, ...]  # The name of a method of Prepared, and its arguments.
Reply = tuple[str, str, Any]  # The worker's name, the kind of its device (kind_of), and the result of the method.


# --- installations, and Dask's scheduler ------------------------------------------------------------------------------


def _code() -> str:
    """Return a digest of the source files of wrt and kernels: two checkouts of one version can differ in any line."""
    folders = [("", Path(__file__).parents[1]), *(("kernels/", Path(folder)) for folder in import_module("wrt.kernels").__path__)]
    files = {before + path.relative_to(folder).as_posix(): path.read_bytes()
             for before, folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".h", ".cpp", ".cu")}
    return sha256(b"".join(name.encode() + sha256(files[name]).digest() for name in sorted(files))).hexdigest()[:16]


# What can change a bit of a result and must be equal on all machines that share work. It is read once, at import, because a file that
# changes later is not the code that runs. A minor version of Python can change arithmetic, as 3.12 changed the sum() of floats.
INSTALLED = {"wrt": VERSION, "Python": "{}.{}".format(*sys.version_info), "NumPy": np.__version__, "Warp": wp.__version__,
             "code of wrt": _code()}


def check_installed(worker: str, there: dict[str, str], here: dict[str, str] = INSTALLED) -> None:
    """Raise InputError if the installation `there`, of a worker, differs from the installation `here`."""
    differ = [f"{name} {there.get(name)} (here {value})" for name, value in here.items() if there.get(name) != value]
    if differ:
        raise InputError(f"worker {worker} has {'; '.join(differ)}", hint="install the same everywhere")


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
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except Exception as error:  # if another program answers, the error can have any type
        raise InputError(f"no Dask scheduler at {address!r}: {error or f'no answer in {CONNECT_SECONDS:g} s'}") from error
    with client:
        check_workers(client)
        yield client


def check_workers(client: "Client") -> None:
    """Raise InputError if there is no worker, or if a worker lacks wrt or has a different installation than this process."""
    if client.asynchronous:
        raise InputError("is an asynchronous Client", argument="executor", hint="make one without asynchronous=True")
    where = client.scheduler.address  # type: ignore[union-attr]
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise InputError(f"no worker at {where}", hint=f"start some with `dask worker {where}`") from error
    # Workers without wrt can run `resolve_name`.
    for worker, found in client.run(pkgutil.resolve_name, "wrt.renderer.workers:INSTALLED", on_error="return").items():
        if isinstance(found, BaseException):
            raise InputError(f"worker {worker} lacks this version of wrt ({found})", hint=f"install wrt {VERSION} on the worker")
        check_installed(worker, found)


# --- in a worker ------------------------------------------------------------------------------------------------------


class Package(NamedTuple):
    """What a worker needs to prepare a scene. The scene is pickled by itself, so that another installation is refused before."""

    installed: dict[str, str]
    kernels: str  # Plan.kernels_hash.
    options: dict[str, Any]
    scene: bytes


_ready: OrderedDict[str, Prepared] = OrderedDict()
_lock = threading.Lock()


def call(key: str, package: Package, method: str, *arguments: object) -> Reply:
    """Call a method of the prepared scene (Prepared) that this worker keeps under `key`, after preparing it from `package` if needed.

    Raises InputError if the caller has a different installation."""
    with _lock:
        if key not in _ready:
            check_installed(worker_name(), INSTALLED, package.installed)
            prepared = _prepared(pickle.loads(package.scene), Options(**package.options))
            if prepared.plan.kernels_hash() != package.kernels:
                raise InputError(f"worker {worker_name()} generates other kernels from the same code")
            _ready[key] = prepared
        _ready.move_to_end(key)
        while len(_ready) > CACHED:
            _ready.popitem(last=False)
        prepared = _ready[key]
    return worker_name(), kind_of(prepared.device), getattr(prepared, method)(*arguments)


def _prepared(scene: Scene, options: Options) -> Prepared:
    plan, device = plan_of(scene, options), start(options.device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # the caller reports the warnings
        return prepare(plan, device)


def worker_name() -> str:
    return f"{socket.gethostname()}:{os.getpid()}"


# --- in the process that renders --------------------------------------------------------------------------------------


class Workers(NamedTuple):
    """Workers of a cluster. submit: starts a job, and returns the Future of its Reply. slots: number of jobs that can run at once."""

    submit: Callable[[Job], "Future[Reply]"]
    slots: int

    def run(self, jobs: Iterable[Job]) -> Generator[tuple[Job, Reply] | None, None, None]:
        """Run jobs. Yield each job with its reply, in any order. While no reply comes, yield None every tenth of a second.

        A job is taken from `jobs` just before it is submitted. When the caller closes the generator, waiting jobs are cancelled."""
        coming, done = iter(jobs), False
        pending: dict[Future[Reply], Job] = {}
        try:
            while pending or not done:
                while len(pending) < QUEUED * self.slots:
                    job = next(coming, None)
                    if job is None:
                        done = True
                        break
                    try:
                        pending[self.submit(job)] = job
                    except Exception as error:  # the connection is closed
                        raise lost(error) from error
                finished = wait(pending, timeout=STEP_SECONDS, return_when=FIRST_COMPLETED).done
                for future in finished:
                    yield pending.pop(future), future.result()
                if not finished:
                    yield None
        except (CancelledError, OSError) as error:
            raise lost(error) from error
        finally:
            for future in pending:
                future.cancel()


def lost(error: BaseException) -> InputError:
    return InputError(f"its workers are lost: {error or type(error).__name__}", argument="executor")


def workers_for(plan: Plan) -> Workers:
    """Return the workers of the Client that the plan's options name, to which the scene is sent once."""
    client: Any = plan.options.executor
    check_workers(client)
    scene, options = replace(plan.scene, cameras=(plan.camera,)), replace(plan.options, camera=None, accel=plan.accel)
    sent = {name: getattr(options, name) for name in OPTIONS_SENT}
    package = Package(INSTALLED, plan.kernels_hash(), sent, pickle.dumps(scene, pickle.HIGHEST_PROTOCOL))
    key = sha256(f"{package[:3]}{digest(scene)}{digest(plan.camera)}{scene.settings}".encode()).hexdigest()
    (there,) = client.scatter([package], broadcast=True, hash=False)
    slots, executor = max(1, sum(client.nthreads().values())), client.get_executor(pure=False)
    return Workers(lambda job: executor.submit(call, key, there, *job), slots)


class WorkersTracer:
    """A scene that workers have prepared. It implements Tracer (wrt.renderer.schedule)."""

    def __init__(self, plan: Plan, workers: Workers) -> None:
        self.device = start("cpu")  # the film's device
        self.plan, self.workers, self.tiles_by = plan, workers, Counter[str]()
        begin, progress, replies = time.perf_counter(), plan.options.progress, list[Reply]()
        with nullcontext() if progress is None else WATCH.reported_by_caller():
            for done in workers.run([("ready",)] * workers.slots):
                seconds = time.perf_counter() - begin
                if done is not None:
                    replies.append(done[1])
                elif progress is not None and seconds >= WATCH.delay:
                    progress(Progress(0, 100, 0, seconds, stage="compile"))
                    progress = None
        self.kind, self.counts = replies[0][1], replies[0][2]["facts"]
        for reply in replies:
            self._check(reply)
        slowest: dict[str, float] = max((reply[2]["seconds"] for reply in replies), key=lambda each: max(each.values()))
        waited = time.perf_counter() - begin  # shorter, if the worker has prepared the scene for an earlier render
        self.seconds = {name: min(value, waited) for name, value in slowest.items()}

    def _check(self, reply: Reply) -> None:
        if reply[1] != self.kind:
            raise InputError("the workers' devices are of several kinds, which round differently:"
                             f" {self.kind}, and {reply[1]} of {reply[0]}")

    def facts(self) -> Facts:
        return {**self.counts, "workers": dict(self.tiles_by)}

    def tiles(self, samples: int) -> Iterator[Rectangle]:
        """Yield the tiles of a pass. Tiles are large for any number of samples, since a call to a worker costs more than a wave."""
        low, high = SIDES["cuda" if self.plan.options.device.startswith("cuda") else "cpu"]
        side = math.ceil(math.sqrt(self.plan.area / (TILES_EACH * self.workers.slots)))
        return tiles(self.plan.crop, self.plan.options.tile_size or min(max(side, low), high))

    def trace(self, film: DeviceFilm | AovFilm, work: list[Work], due: Callable[[], bool]) -> Steps:
        """Trace as Tracer.trace does. The film receives finished tiles only, so that each step may report that no tile is running."""
        jobs: Iterable[Job]
        if isinstance(film, AovFilm):
            views = [film.view(name) for name in self.plan.options.aov]
            jobs = (("aov_tile", part) for part in work)
        else:
            views = [film.view(array) for _, array in film.arrays()]
            jobs = (("trace_tile", part, film.seed, [view[self._place(part.rectangle)] for view in views] if part.first else None)
                    for part in work)
        total, next_step = 0, 0.0
        with closing(self.workers.run(jobs)) as running:
            for done in running:
                if done is not None:
                    (_, part, *_), reply = done
                    self._check(reply)  # a new worker may have connected meanwhile
                    self.tiles_by[reply[0]] += 1
                    total += part.total
                    for view, array in zip(views, reply[2], strict=True):
                        view[self._place(part.rectangle)] = array
                if time.monotonic() >= next_step:
                    yield total, True
                    next_step = time.monotonic() + STEP_SECONDS
            yield total, True

    def _place(self, rectangle: Rectangle) -> tuple[slice, slice]:
        x, y, width, height = rectangle
        x, y = x - self.plan.crop[0], y - self.plan.crop[1]
        return slice(y, y + height), slice(x, x + width)


def render_with_workers(scene: Scene, options: Options) -> Film:
    """Render a scene for options with an `executor`."""
    plan = plan_of(scene, options)
    plan.require_memory(start("cpu"))
    warn_left_out(scene)
    tracer = WorkersTracer(plan, workers_for(plan))
    return Run(tracer, None if options.checkpoint is None else checkpoint_of(plan, options.checkpoint, tracer.kind)).film()
