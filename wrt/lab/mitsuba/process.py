"""Run Mitsuba with one variant and one scene in its own process, so that a crash does not end the measurement.

For example, LLVM 15 and 16 crash at the first picture."""

import importlib
import importlib.util
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"  # where Mitsuba's compiler, Dr.Jit, looks for LLVM


def llvm_missing() -> str:
    """Return the reason why llvm_ad_rgb finds no LLVM library, or ""."""
    library = os.environ.get(PATH_VARIABLE, "")
    if os.path.isfile(library):
        return ""
    problem = f"names no file: {library}" if library else "is not set"
    return f"llvm_ad_rgb needs an LLVM library, and {PATH_VARIABLE} {problem}; set it to the path of libLLVM (19 works)"


class Job(NamedTuple):
    """Task of a process: variant, scene, camera (or its name or index in the scene), integrator, and number of threads."""

    variant: str
    scene: Scene
    camera: CameraKind | str | int | None
    integrator: str
    threads: int


class MitsubaProcess:
    """A process that loads the scene and then renders pictures until it is closed. load_seconds: time to load the scene.

    Raise InputError if the variant is not usable, Mitsuba cannot render the scene exactly, or the process has ended."""

    def __init__(self, job: Job) -> None:
        if importlib.util.find_spec("mitsuba") is None:
            raise InputError("Mitsuba 3 is not usable (not installed)", hint='pip install "wrt[peers]" installs it')
        if job.variant.startswith("llvm") and (reason := llvm_missing()):
            raise InputError(reason)
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        self.load_seconds: float = self._ask(load, job)

    def render(self, spp: int, seed: int) -> tuple[float, np.ndarray]:
        """Render a picture; return its seconds and pixels (H, W, 3) float32."""
        found: tuple[float, np.ndarray] = self._ask(render, spp, seed % 2**31)
        return found

    def _ask(self, function: Any, *arguments: object) -> Any:
        try:
            return self._pool.submit(function, *arguments).result()
        except BrokenProcessPool as error:
            raise InputError("its process ended without an answer") from error

    def __enter__(self) -> "MitsubaProcess":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._pool.shutdown(wait=kind is None, cancel_futures=True)


loaded: dict[str, Any] = {}  # of this process: Mitsuba's context, module and scene


def load(job: Job) -> float:
    """Load a scene in this process; return the seconds. Raise InputError if Mitsuba cannot."""
    os.dup2(2, 1)  # output to stderr, since the parent's standard output may be JSON
    try:
        loaded["context"] = mitsuba(job.variant)
        loaded["mi"] = loaded["context"].__enter__()
        importlib.import_module("drjit").set_thread_count(job.threads)
        begin = time.perf_counter()
        loaded["scene"] = translate(loaded["mi"], job.scene, job.camera, job.integrator).scene
        return time.perf_counter() - begin
    except (ImportError, RuntimeError) as error:  # for example a library that cannot be loaded
        raise InputError(str(error)) from None


def render(spp: int, seed: int) -> tuple[float, np.ndarray]:
    """Render the loaded scene; return the seconds and pixels (H, W, 3) float32."""
    begin = time.perf_counter()
    pixels = np.array(loaded["mi"].render(loaded["scene"], spp=spp, seed=seed), dtype=np.float32)
    return time.perf_counter() - begin, pixels
