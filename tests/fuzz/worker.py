"""Read damaged files one after another, and print defects as JSON: tests/fuzz/__main__.py starts `python -m tests.fuzz.worker`.

The file `beat` in the worker's folder holds the number of the input in work plus 1, so that its parent sees progress.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.fuzz import seeds
from tests.fuzz.formats import ALL_FORMATS, Format, make_case
from wrt.core.errors import InputError, SceneWarning

ROOM = 1 << 30  # bytes of address space that a worker may allocate for the inputs
HANG, STUCK = 40.0, 60.0  # longest processor time of an input, and longest time: the system then ends the worker


class Judge:
    """Read files, and describe what went wrong."""

    def __init__(self, form: Format, folder: Path) -> None:
        self.form, self.folder = form, folder
        self.stderr: Any = None
        self.outcomes = {"read": 0, "refused": 0, "out of memory": 0}
        self.slowest = (0.0, -1)
        seeds.side_files(folder)
        if not (folder / "pipe").exists():
            os.mkfifo(folder / "pipe")

    @contextlib.contextmanager
    def watching_stderr(self) -> Iterator[None]:
        """Redirect file descriptor 2 to a file during the block, because C libraries write to it directly."""
        before = os.dup(2)
        with open(self.folder / "stderr", "w+b") as self.stderr:
            os.dup2(self.stderr.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(before, 2)
                os.close(before)
                self.stderr = None

    def read(self, number: int, seed: seeds.Seed) -> str:
        """Write the file and read it. Return "" or the problem, whose first line has no details, so that equal problems group."""
        path = self.folder / f"case{seed.suffix}"
        path.write_bytes(seed.data)
        begin = time.process_time()  # wall time would count pauses of the process
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            problem = self._attempt(path)
        seconds = time.process_time() - begin
        self.slowest = max(self.slowest, (seconds, number))
        others = [each for each in caught if not issubclass(each.category, SceneWarning)]
        if others and not problem:
            problem = f"{others[0].category.__name__} in {others[0].filename}:{others[0].lineno}\n{others[0].message}"
        if self.stderr is not None and os.fstat(self.stderr.fileno()).st_size:
            self.stderr.seek(0)
            problem = problem or f"stderr\n{self.stderr.read().decode(errors='replace')}"
            self.stderr.seek(0)
            self.stderr.truncate()
        return problem

    def _attempt(self, path: Path) -> str:
        try:
            self.form.read(path)
        except InputError as error:
            self.outcomes["refused"] += 1
            if isinstance(error.__cause__, MemoryError) or not str(error).strip():
                return f"InputError by {type(error.__cause__).__name__} at {_place(error)}\n{error}"
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:
            if isinstance(error, MemoryError) and self.form.names_sizes:
                self.outcomes["out of memory"] += 1
                return ""
            return f"{type(error).__name__} at {_place(error)}\n{traceback.format_exc()}"
        else:
            self.outcomes["read"] += 1
        return ""


def _place(error: BaseException) -> str:
    """Return the file and line of the innermost frame of the traceback that is in the project."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/wrt/" in f.filename or "/tests/" in f.filename]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"


def main(name: str, seed: str, first: str, count: str, folder: str) -> None:
    judge = Judge(ALL_FORMATS[name], Path(folder))
    out = os.fdopen(os.dup(1), "w")
    beat = os.open(Path(folder) / "beat", os.O_WRONLY | os.O_CREAT)
    with judge.watching_stderr():
        for each in judge.form.seeds():  # so that imports, kernels and caches are in memory before the limit is set
            judge.read(-1, each)
        judge.outcomes = dict.fromkeys(judge.outcomes, 0)
        judge.slowest = (0.0, -1)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
        begin = time.perf_counter()
        for number in range(int(first), int(first) + int(count)):
            os.pwrite(beat, (number + 1).to_bytes(8, "little"), 0)
            signal.setitimer(signal.ITIMER_PROF, HANG)
            signal.setitimer(signal.ITIMER_REAL, STUCK)
            case = make_case(judge.form, random.Random(f"{seed} {name} {number}"))
            if problem := judge.read(number, case):
                print(json.dumps({"number": number, "problem": problem, "suffix": case.suffix}), file=out, flush=True)
        summary = {"done": int(count), **judge.outcomes, "slowest": judge.slowest, "seconds": time.perf_counter() - begin}
        print(json.dumps(summary), file=out, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
