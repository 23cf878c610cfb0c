"""Mitsuba with one variant and one scene in a process of its own, so that a crash in it ends no measurement: an LLVM library that
does not suit Mitsuba ends the whole process as soon as a picture is rendered (LLVM 15 and 16 do)."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"  # where Mitsuba's compiler, Dr.Jit, looks for LLVM
VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
SECONDS_TO_END = 10.0


class NotAvailable(InputError):
    """A variant of Mitsuba that cannot be used here, and why."""


def require_llvm() -> None:
    """Raise NotAvailable unless DRJIT_LIBLLVM_PATH names a file."""
    library = os.environ.get(PATH_VARIABLE, "")
    if not os.path.isfile(library):
        is_now = f"names no file: {library}" if library else "is not set"
        raise NotAvailable(f"llvm_ad_rgb needs an LLVM library, and {PATH_VARIABLE} {is_now}; set it to libLLVM's path (19 works)")


class Job(NamedTuple):
    """What a process renders: a variant (of VARIANTS), the scene, its camera (or that by name or number), an integrator of
    wrt.lab.mitsuba.translate, and how many threads it may use."""

    variant: str
    scene: Scene
    camera: CameraKind | str | int | None
    integrator: str
    threads: int


class MitsubaProcess:
    """One that is started, has loaded the scene in `load_seconds`, and renders until it is closed.

    Raises NotAvailable where the variant cannot be used here or its process has ended, InputError for a scene that Mitsuba cannot
    draw exactly, and where Mitsuba is missing.
    """

    def __init__(self, job: Job) -> None:
        if importlib.util.find_spec("mitsuba") is None:
            raise InputError('Mitsuba 3 is not usable (not installed); pip install "wrt[peers]" installs it')
        if job.variant != "scalar_rgb" and job.integrator == "whitted":
            raise NotAvailable('the integrator "whitted" is Python that only scalar_rgb can run')
        if job.variant.startswith("llvm"):
            require_llvm()
        spawn = multiprocessing.get_context("spawn")
        self._pipe, childs = spawn.Pipe()
        self._process = spawn.Process(target=serve, args=(childs, job), daemon=True)
        self._process.start()
        childs.close()
        try:
            self.load_seconds: float = self._ask()
        except BaseException:
            self._process.kill()
            self.close()
            raise

    def render(self, spp: int, seed: int) -> tuple[float, np.ndarray]:
        """Seconds, and the picture (H, W, 3) float32."""
        return self._ask((spp, seed % 2**31))

    def _ask(self, *questions: tuple[int, int]) -> Any:
        try:
            for question in questions:
                self._pipe.send(question)
            answer = self._pipe.recv()
        except (OSError, EOFError) as error:
            self._process.join()
            code = self._process.exitcode or 0
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            raise NotAvailable(f"its process ended with {how}") from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End the process; it may be asked no more."""
        self._pipe.close()
        self._process.join(SECONDS_TO_END)
        self._process.kill()
        self._process.join()

    def __enter__(self) -> MitsubaProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if kind is not None:
            self._process.kill()  # it may be in the middle of a picture that nobody waits for
        self.close()


def serve(pipe: Connection, job: Job) -> None:
    """The child: load the scene, then render what it is asked for until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    os.dup2(2, 1)  # the parent's standard output may be JSON
    try:
        with mitsuba(job.variant) as mi:
            importlib.import_module("drjit").set_thread_count(job.threads)
            begin = time.perf_counter()
            scene = translate(mi, job.scene, job.camera, job.integrator).scene
            pipe.send(time.perf_counter() - begin)
            while True:
                spp, seed = pipe.recv()
                begin = time.perf_counter()
                pixels = np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float32)
                pipe.send((time.perf_counter() - begin, pixels))
    except EOFError:
        return
    except InputError as error:
        pipe.send(error)
    except (ImportError, RuntimeError) as error:  # a library that cannot be loaded
        pipe.send(NotAvailable(str(error)))
