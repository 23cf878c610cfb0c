"""Mitsuba with one variant and one scene in a process of its own: what ends that process ends no measurement, and an LLVM library
can be chosen for it: unfit ones end the whole process (LLVM 15 and 16 as soon as a picture is rendered), so that each is tried in a
process of its own before it is used.

Parent and child send each other pickles: a Job and (spp, seed) one way; seconds, pictures or an InputError the other.
"""

from __future__ import annotations

import ctypes.util
import glob
import importlib.util
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

import wrt
from wrt.core.errors import InputError
from wrt.lab.mitsuba.translate import mitsuba, translate
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"  # where Mitsuba's compiler, Dr.Jit, looks for it
CACHE_VARIABLE = "DRJIT_CACHE_DIR"
PLACES = ("/usr/lib", "/usr/lib/*", "/usr/lib/llvm*/lib", "/usr/lib64", "/usr/lib64/llvm*/lib*", "/usr/local/lib",
          "/usr/local/opt/llvm*/lib", "/opt/homebrew/opt/llvm*/lib", f"{sys.prefix}/lib")
NAME = re.compile(r"libLLVM([-.]\d+)*\.(so|dylib)(\.\d+)*")  # not libLLVMCore.so and the like, which are parts of it
TRIAL_SECONDS = 120.0
# All that ends processes shows in a picture of light that passes glass; the library alone may load well.
TRIAL = """\
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
                      "ball": {"type": "sphere", "bsdf": {"type": "dielectric"}},
                      "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4},
                                 "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}})
if not abs(np.array(mi.render(scene, spp=4)).mean() - 1.0) < 0.5:
    raise SystemExit("its picture of glass under a white sky is not white")
"""


class NotAvailable(InputError):
    """A variant of Mitsuba that cannot be used here, and why."""


def llvm_library() -> str:
    """The first library that passes the trial: that of DRJIT_LIBLLVM_PATH and no other where it is set, else the newest in the
    usual places. Raises NotAvailable, with what came of each."""
    tried = []
    for library in candidates():
        reason = trial(library, TRIAL, TRIAL_SECONDS)
        if reason is None:
            return library
        tried.append(f"{library}: {reason}")
    if not tried:
        raise NotAvailable(f"no LLVM library (libLLVM) found; install one (19 works), or name it in {PATH_VARIABLE}")
    raise NotAvailable(f"no LLVM library is fit for it (19 is; {PATH_VARIABLE} names one): {'; '.join(tried)}")


def candidates() -> list[str]:
    """Libraries to try, newest first."""
    named = os.environ.get(PATH_VARIABLE)
    if named:
        return [named]
    files = [path for place in PLACES for path in glob.glob(f"{place}/libLLVM*") if NAME.fullmatch(Path(path).name)]
    found = list(dict.fromkeys(os.path.realpath(path) for path in files))
    linked = ctypes.util.find_library("LLVM")  # where the system's linker finds one, which may be elsewhere; on Linux a bare name
    if linked and os.path.basename(linked) not in {os.path.basename(path) for path in files}:
        found.append(linked)
    return sorted(found, key=_version, reverse=True)


def _version(library: str) -> tuple[int, ...]:
    """Numbers of the file's name, or where it has none, of the last folder that has some."""
    for part in reversed(Path(library).parts):
        numbers = tuple(map(int, re.findall(r"\d+", part)))
        if numbers:
            return numbers
    return ()


@cache
def trial(library: str, program: str, seconds: float) -> str | None:
    """Run a Python program with this library, and with no kernels that another one has compiled; None where it ends well, else
    what came of it."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, PATH_VARIABLE: library, CACHE_VARIABLE: folder}
        try:
            done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True,
                                  errors="replace", timeout=seconds)
        except subprocess.TimeoutExpired:
            return f"not done after {seconds:g} s"
    return None if done.returncode == 0 else ended(done.returncode, done.stderr)


def ended(code: int, stderr: str) -> str:
    """How a process ended, with the first line that it said, or the last of a traceback."""
    signals = {each.value: each.name for each in signal.Signals}
    how = f"exit code {code}" if code >= 0 else f"ended by {signals.get(-code, f'signal {-code}')}"
    lines = [line.strip() for line in stderr.splitlines() if line.strip()] or [""]
    said = lines[-1] if lines[0].startswith("Traceback ") else lines[0]
    return f"{how} ({said[:120]})" if said else how


# --- the process ------------------------------------------------------------------------------------------------------

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
