"""Which LLVM library Mitsuba's variant llvm_ad_rgb gets. Unfit ones end the whole process (LLVM 15 and 16 as soon as a picture is
rendered), so each is tried in a process of its own before it is used."""

from __future__ import annotations

import ctypes.util
import glob
import os
import re
import signal
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from wrt.core.errors import InputError

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
