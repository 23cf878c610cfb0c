"""Run Mitsuba with one variant and one scene in its own process, so that a crash does not end the measurement.

For example, LLVM 15 and 16 crash at the first picture."""

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
SECONDS_TO_END = 10.0  # time to exit before the process is killed


class NotAvailable(InputError):
    """A variant of Mitsuba cannot be used on this machine; the message says why."""


def require_llvm() -> None:
    """Raise NotAvailable unless DRJIT_LIBLLVM_PATH names a file."""
    library = os.environ.get(PATH_VARIABLE, "")
    if not os.path.isfile(library):
        problem = f"names no file: {library}" if library else "is not set"
        raise NotAvailable(f"llvm_ad_rgb needs an LLVM library, and {PATH_VARIABLE} {problem}; set it to the path of libLLVM (19 works)")


class Job(NamedTuple):
    """Task of a process: variant, scene, camera (or its name or index in the scene), integrator, and number of threads."""

    variant: str
    scene: Scene
    camera: CameraKind | str | int | None
    integrator: str
    threads: int


class MitsubaProcess:
    """A process that loads the scene and then renders pictures until it is closed. load_seconds: time to load the scene.

    Raise NotAvailable if the variant is not usable or the process has ended. Raise InputError if Mitsuba is missing or cannot render the
    scene exactly."""

    def __init__(self, job: Job) -> None:
        if importlib.util.find_spec("mitsuba") is None:
            raise InputError("Mitsuba 3 is not usable (not installed)", hint='pip install "wrt[peers]" installs it')
        if job.variant != "scalar_rgb" and job.integrator == "whitted":
            raise NotAvailable('the integrator "whitted" is written in Python, which only scalar_rgb can run')
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
        """Render a picture; return its seconds and pixels (H, W, 3) float32."""
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
        """End the process."""
        self._pipe.close()
        self._process.join(SECONDS_TO_END)
        self._process.kill()
        self._process.join()

    def __enter__(self) -> "MitsubaProcess":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if kind is not None:
            self._process.kill()  # it may still render a picture that is not needed
        self.close()


def serve(pipe: Connection, job: Job) -> None:
    """Load the scene, then render on request until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends this process
    os.dup2(2, 1)  # output to stderr, since the parent's standard output may be JSON
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
    except (ImportError, RuntimeError) as error:  # for example a library that cannot be loaded
        pipe.send(NotAvailable(str(error)))
