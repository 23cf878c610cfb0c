"""Mitsuba with one variant and one scene in a process of its own: what ends that process ends no measurement, and an LLVM library
can be chosen for it.

Parent and child send each other pickles: a Job and (spp, seed) one way; seconds, pictures or an InputError the other.
"""

from __future__ import annotations

import importlib.util
import os
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

import wrt
from wrt.core.errors import InputError
from wrt.lab.mitsuba.llvm import PATH_VARIABLE, NotAvailable, ended, llvm_library
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
SECONDS_TO_END = 10.0


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
        environment = environment_of(job.variant)
        self._stderr = tempfile.TemporaryFile()
        self._process = subprocess.Popen([sys.executable, "-m", __name__], env=environment, stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE, stderr=self._stderr)
        try:
            self.load_seconds: float = self._ask(job)
        except BaseException:
            self._process.kill()
            self.close()
            raise

    def render(self, spp: int, seed: int) -> tuple[float, np.ndarray]:
        """Seconds, and the picture (H, W, 3) float32."""
        return self._ask((spp, seed % 2**31))

    def _ask(self, question: Any) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        data = pickle.dumps(question)
        try:
            self._process.stdin.write(data)
            self._process.stdin.flush()
            answer = pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            code = self._process.wait()
            self._stderr.seek(0)
            raise NotAvailable(f"its process {ended(code, self._stderr.read().decode(errors='replace'))}") from error
        if isinstance(answer, InputError):
            raise answer
        return answer

    def close(self) -> None:
        """End the process; it may be asked no more."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            try:
                pipe.close()
            except BrokenPipeError:
                pass  # it has ended by itself
        try:
            self._process.wait(SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._stderr.close()

    def __enter__(self) -> MitsubaProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if kind is not None:
            self._process.kill()  # it may be in the middle of a picture that nobody waits for
        self.close()


def environment_of(variant: str) -> dict[str, str]:
    """The environment of a process that uses a variant: this package can be imported, and LLVM found. Raises NotAvailable."""
    package = str(Path(wrt.__file__).resolve().parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return environment | {PATH_VARIABLE: llvm_library()} if variant.startswith("llvm") else environment


def serve() -> None:
    """The child: load the scene, then render what it is asked for until nobody asks any more."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints shall not print between the answers

    def answer(value: Any) -> None:
        pickle.dump(value, answers)
        answers.flush()

    job: Job = pickle.load(sys.stdin.buffer)
    try:
        with mitsuba(job.variant) as mi:
            importlib.import_module("drjit").set_thread_count(job.threads)
            begin = time.perf_counter()
            scene = translate(mi, job.scene, job.camera, job.integrator).scene
            answer(time.perf_counter() - begin)
            while True:
                spp, seed = pickle.load(sys.stdin.buffer)
                begin = time.perf_counter()
                pixels = np.array(mi.render(scene, spp=spp, seed=seed), dtype=np.float32)
                answer((time.perf_counter() - begin, pixels))
    except InputError as error:
        answer(error)
    except EOFError:
        return


if __name__ == "__main__":
    serve()
