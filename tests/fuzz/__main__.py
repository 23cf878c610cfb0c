"""Fuzz the readers of files: `python -m tests.fuzz --inputs 1000000 --workers 2 --out FOLDER`.

Each format gets the same number of inputs. Workers are processes, so that a crash or a hang costs one input, which is counted and
saved. The same seed makes the same inputs: `--format ply --first 1234 --inputs 1` repeats one input.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.formats import ALL_FORMATS, FORMATS, make_case

AT_ONCE = 20_000  # Inputs per process.


@dataclass
class Tally:
    """The outcomes of one format's inputs."""

    inputs: int = 0
    read: int = 0
    refused: int = 0
    out_of_memory: int = 0
    crashes: int = 0
    hangs: int = 0
    seconds: float = 0.0
    slowest: tuple[float, int] = (0.0, -1)  # processor time in seconds, and number of the input
    defects: dict[str, list[int]] = field(default_factory=dict)  # numbers of inputs by the problem's first line


class Run:
    """Run the inputs of one format in worker processes, one after another."""

    def __init__(self, name: str, seed: int, out: Path) -> None:
        self.name, self.seed, self.out, self.tally = name, seed, out, Tally()

    def work(self, first: int, count: int) -> None:
        """Run the inputs first .. first + count - 1."""
        end = first + count
        while first < end:
            first = self._process(first, min(end, first + AT_ONCE))

    def _process(self, first: int, end: int) -> int:
        """Run a worker until it ends; return the number of the first input that is left to do."""
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
            command = [sys.executable, "-m", "tests.fuzz.worker", self.name, str(self.seed), str(first), str(end - first), folder]
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            with open(Path(folder) / "reports", "w+") as reports, open(Path(folder) / "errors", "w+") as errors:
                code = subprocess.run(command, stdout=reports, stderr=errors, env=environment, check=False).returncode
                reports.seek(0)
                lines = [json.loads(line) for line in reports if line.endswith("\n")]
                errors.seek(0)
                text = errors.read()
            self._count(lines)
            if lines and "done" in lines[-1]:
                return end
            last = int.from_bytes((Path(folder) / "beat").read_bytes(), "little") - 1 if (Path(folder) / "beat").exists() else -1
            ended = "hangs" if -code in (signal.SIGPROF, signal.SIGALRM) else "crashes"
            if last < 0:
                raise SystemExit(f"{self.name}: the worker did not begin ({ended}): {text}")
            setattr(self.tally, ended, getattr(self.tally, ended) + 1)
            self.tally.inputs += last + 1 - first
            self._defect(last, f"{ended}: exit code {code}\n{text}")
            return last + 1

    def _count(self, lines: list[dict[str, Any]]) -> None:
        for line in lines:
            if "problem" in line:
                self._defect(line["number"], line["problem"])
            else:
                self.tally.inputs += line["done"]
                self.tally.read += line["read"]
                self.tally.refused += line["refused"]
                self.tally.out_of_memory += line["out of memory"]
                self.tally.seconds += line["seconds"]
                self.tally.slowest = max(self.tally.slowest, tuple(line["slowest"]))

    def _defect(self, number: int, problem: str) -> None:
        numbers = self.tally.defects.setdefault(problem.split("\n")[0], [])
        numbers.append(number)
        if len(numbers) <= 3:  # save at most three inputs of each kind
            case = make_case(ALL_FORMATS[self.name], random.Random(f"{self.seed} {self.name} {number}"))
            self.out.mkdir(parents=True, exist_ok=True)
            (self.out / f"{self.name}-{number}{case.suffix}").write_bytes(case.data)
            (self.out / f"{self.name}-{number}.txt").write_text(problem)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=80_000, help="number of inputs of all formats together")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--format", action="append", choices=list(ALL_FORMATS), help="only this format; may be repeated")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first input of each format")
    parser.add_argument("--out", type=Path, default=Path("fuzz-defects"), help="folder for the inputs with defects; is emptied first")
    options = parser.parse_args()
    names = options.format or list(FORMATS)
    shutil.rmtree(options.out, ignore_errors=True)
    runs = [Run(name, options.seed, options.out) for name in names]
    begin = time.perf_counter()
    with ThreadPoolExecutor(options.workers) as pool:
        for run, future in [(run, pool.submit(run.work, options.first, -(-options.inputs // len(names)))) for run in runs]:
            future.result()
            tally = run.tally
            slowest, which = tally.slowest
            print(f"{run.name}: {tally.inputs} inputs, {tally.read} read, {tally.refused} refused,"
                  f" {tally.out_of_memory} out of memory, {tally.crashes} crashes, {tally.hangs} hangs,"
                  f" {sum(map(len, tally.defects.values()))} defects; slowest: {slowest:.2f} s (input {which}),"
                  f" mean: {1e3 * tally.seconds / max(tally.inputs, 1):.2f} ms", flush=True)
            for problem, numbers in sorted(tally.defects.items(), key=lambda item: -len(item[1])):
                print(f"  {len(numbers)} x {problem} ({', '.join(map(str, numbers[:3]))})", flush=True)
    total = sum(run.tally.inputs for run in runs)
    defects = sum(len(numbers) for run in runs for numbers in run.tally.defects.values())
    print(f"{total} inputs, {defects} defects, {time.perf_counter() - begin:.0f} s")
    raise SystemExit(1 if defects else 0)


if __name__ == "__main__":
    main()
