"""Reads damaged files one after another in this process, and tells what went wrong: `python -m tests.fuzz.worker ARGUMENTS`.

Whoever started it looks at the file `beat` in its folder, which holds the number of the case in work, to see that it is alive.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import random
import resource
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

ROOM = 1 << 30  # bytes of address space beyond what a worker has when it begins


class Judge:
    """Reads files in a folder and says what is wrong with how that went."""

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
        """File descriptor 2 goes to a file during the block: libraries in C write to it past Python."""
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
        """Write the file and read it: "" where that went well, else what is wrong, its first line without details."""
        path = self.folder / f"case{seed.suffix}"
        path.write_bytes(seed.data)
        begin = time.process_time()  # who stops the process for a while makes no case slow
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            problem = self._attempt(path)
        seconds = time.process_time() - begin
        self.slowest = max(self.slowest, (seconds, number))
        problem = problem or next(
            (
                f"{each.category.__name__} in {each.filename}:{each.lineno}\n{each.message}"
                for each in caught
                if not issubclass(each.category, SceneWarning)
            ),
            "",
        )
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
    """The last line of the project that it came through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/wrt/" in f.filename or "/tests/" in f.filename]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"


def main(name: str, seed: str, first: str, count: str, folder: str) -> None:
    judge = Judge(ALL_FORMATS[name], Path(folder))
    out = os.fdopen(os.dup(1), "w")
    beat_path = Path(folder) / "beat"
    beat_path.write_bytes(b"\0" * 8)
    with open(beat_path, "r+b") as file, mmap.mmap(file.fileno(), 8) as beat, judge.watching_stderr():
        for each in judge.form.seeds():  # imports, compiles, takes its memory
            judge.read(-1, each)
        judge.outcomes = dict.fromkeys(judge.outcomes, 0)
        judge.slowest = (0.0, -1)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
        begin = time.perf_counter()
        for number in range(int(first), int(first) + int(count)):
            beat[:] = (number + 1).to_bytes(8, "little")
            case = make_case(judge.form, random.Random(f"{seed} {name} {number}"))
            if problem := judge.read(number, case):
                print(json.dumps({"number": number, "problem": problem, "suffix": case.suffix}), file=out, flush=True)
        print(
            json.dumps({"done": int(count), **judge.outcomes, "slowest": judge.slowest, "seconds": time.perf_counter() - begin}),
            file=out,
            flush=True,
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
