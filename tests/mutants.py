"""Change one token of the device code at a time, and see whether the tests notice: `python -m tests.mutants --count 60 --seed 0`.

Each mutant is a copy of the project with one change, run with a kernel cache of its own. The tests of the changed file come first, then
tests of hits and pixels. A mutant that no test notices *survives*: the change is equivalent, or a test is missing.
Before the first mutant of a file, its tests run without a change. If they fail, no mutant of that file counts.
`--first 60` goes on after the first 60 mutants of a seed, and `--show` prints the changes without running tests.
"""

from __future__ import annotations

import argparse
import ast
import io
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import tokenize
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue

from tests.data import ROOT

FOLDERS = "kernels/units", "kernels/wide"
SWAPS = {"+": "-", "-": "+", "*": "/", "/": "*", "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "&": "|", "|": "&",
         "&&": "||", "||": "&&", "<<": ">>", ">>": "<<", "and": "or", "or": "and", "min": "max", "max": "min", "True": "False",
         "False": "True", "true": "false", "false": "true", "+=": "-=", "-=": "+=", "&=": "|=", "|=": "&=", "break": "continue"}
# C++: operators stand between spaces, so that template arguments and pointers are no operators.
CPP_TOKEN = re.compile(r"(?<= )(?:[<>=!]=|[-+&|]=|&&|\|\||<<|>>|[-+*/<>&|])(?= )|\b(?:min|max|true|false|break)\b"
                       r"|(?<![\w.])\d+(?:\.\d+)?(?=f?\b)")
CPP_SKIPPED = re.compile(r'//.*|"(?:\\.|[^"\\])*"|^\s*#.*|^\s*(?:template|typedef)\b.*', re.MULTILINE)
# Tests by the name of a changed file, where they are not those of the same name.
TESTS = {"closest_points": "tests/wrt/accel/points/test_closest_points.py",
         "closest_triangle": "tests/wrt/accel/points/test_closest_points.py",
         "nodes": "tests/kernels/wide/test_lanes.py tests/wrt/accel/points/test_closest_points.py",
         "traverse": "tests/kernels/traverse/test_common.py -k bvh4"}
SANITIZE = ["tests/sanitize/test_headers.py", "-k", "results and walks"]
GENERAL = (["tests/test_bits.py", "tests/kernels/wide/test_triangle.py", "-k", "hits and bvh8 or whitted or instances or lanes_clamp"],
           ["tests/kernels/wide/test_packets.py", "tests/kernels/wide/test_batch.py", "tests/kernels/wide/test_instances.py",
            "tests/wrt/accel/queries/test_all_hits.py"])
OUTCOMES = "noticed", "survived", "not counted"
PROCESSOR_SECONDS = 150  # of one run of pytest; an endless loop ends here


@dataclass(frozen=True)
class Mutant:
    """A change: the token at text[begin:end] of a file becomes `new`."""

    path: str
    line: int
    begin: int
    end: int
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: `{self.old}` -> `{self.new}`"

    def apply(self, text: str) -> str:
        assert text[self.begin : self.end] == self.old
        return text[: self.begin] + self.new + text[self.end :]


def changed(token: str) -> str | None:
    """Return what a token becomes; None for a token that is not changed."""
    if re.fullmatch(r"\d+", token):
        return str(int(token) + 1) if token != "1" else "0"
    if re.fullmatch(r"\d*\.\d*(e[-+]?\d+)?", token) and token != ".":
        return "1.0" if float(token) == 0.0 else "0.0" if float(token) == 1.0 else repr(2.0 * float(token))
    return SWAPS.get(token)


def python_tokens(text: str) -> list[tuple[int, int]]:
    """Return begin and end of the tokens of functions' bodies and of constants; annotations, decorators and imports are left out."""
    starts = [0, *accumulate(len(line) for line in text.splitlines(keepends=True))]
    inside = set[int]()  # numbers of lines
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            inside |= {line for each in node.body for line in range(each.lineno, (each.end_lineno or 0) + 1)}
    tree = ast.parse(text)
    inside |= {line for node in tree.body if isinstance(node, ast.Assign) for line in range(node.lineno, (node.end_lineno or 0) + 1)}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):  # of inner functions, too: signatures and decorators
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            inside -= set(range(first, node.body[0].lineno))
        elif isinstance(node, ast.Import | ast.ImportFrom | ast.Assert | ast.Raise):
            inside -= set(range(node.lineno, (node.end_lineno or 0) + 1))
    return [(starts[token.start[0] - 1] + token.start[1], starts[token.end[0] - 1] + token.end[1])
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
            if token.type in (tokenize.OP, tokenize.NUMBER, tokenize.NAME) and token.start[0] in inside]


def cpp_tokens(text: str) -> list[tuple[int, int]]:
    blank = CPP_SKIPPED.sub(lambda found: " " * len(found[0]), text)
    return [found.span() for found in CPP_TOKEN.finditer(blank)]


def mutants_of(path: Path) -> list[Mutant]:
    """Return all one-token changes of a file."""
    text, name = path.read_text("utf-8"), path.relative_to(ROOT).as_posix()
    spans = cpp_tokens(text) if path.suffix == ".h" else python_tokens(text)
    return [Mutant(name, text.count("\n", 0, begin) + 1, begin, end, text[begin:end], new)
            for begin, end in spans if (new := changed(text[begin:end]))]


def sample(seed: int, folders: tuple[str, ...] = FOLDERS) -> list[Mutant]:
    """Return all mutants in an order that depends on the seed."""
    paths = sorted(path for folder in folders for path in (ROOT / folder).iterdir() if path.suffix in (".py", ".h"))
    found = [mutant for path in paths for mutant in mutants_of(path)]
    random.Random(seed).shuffle(found)
    return found


def stages(path: str, thorough: bool) -> list[list[str]]:
    """Return the arguments of pytest for a changed file, the nearest tests first. thorough: add the slow ones."""
    folder, stem = Path(path).parent.name, Path(path).stem
    own = f"tests/kernels/{folder}/test_{stem}.py"
    own = own if (ROOT / own).exists() else TESTS.get(stem, "")
    nearest = [SANITIZE] * path.endswith(".h") + [own.split()] * bool(own)
    return [*nearest, *GENERAL][: None if thorough else len(nearest) + 1]


class Worker:
    """A copy of the project with a kernel cache, in which mutants run one after another."""

    def __init__(self, folder: Path, thorough: bool) -> None:
        self.root, self.cache, self.thorough = folder / "project", folder / "cache", thorough
        self.unchanged: dict[str, str] = {}  # by the arguments of pytest: its first failure without a change
        shutil.copytree(ROOT, self.root, symlinks=True, ignore=shutil.ignore_patterns(".git", "__pycache__", ".*_cache", "docs"))

    def pytest(self, arguments: list[str]) -> str:
        """Run tests; return "" if they pass, else the first failure."""
        data = os.environ.get("WRT_DATA", str(ROOT.parent / "shared" / "data"))
        environment = {**os.environ, "PYTHONPATH": str(self.root), "WARP_CACHE_PATH": str(self.cache), "WRT_DATA": data,
                       "PYTHONDONTWRITEBYTECODE": "1"}
        limit = (PROCESSOR_SECONDS, PROCESSOR_SECONDS)
        done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", "--tb=no", *arguments],
                              cwd=self.root, env=environment, capture_output=True, text=True,
                              preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, limit))
        if done.returncode in (0, 5):  # 5: all deselected
            return ""
        if done.returncode < 0:
            return f"signal {-done.returncode}"
        return next((line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), done.stdout[-200:])

    def baseline(self, arguments: list[str]) -> str:
        """Return the first failure of tests of the unchanged project; "" if they pass."""
        key = " ".join(arguments)
        if key not in self.unchanged:
            self.unchanged[key] = self.pytest(arguments)
        return self.unchanged[key]

    def run(self, mutant: Mutant) -> tuple[str, str]:
        """Return one of OUTCOMES, and the failure."""
        tests = stages(mutant.path, self.thorough)
        if failure := next(filter(None, map(self.baseline, tests)), ""):
            return "not counted", f"its tests fail without a change: {failure}"
        file = self.root / mutant.path
        before = file.read_text("utf-8")
        file.write_text(mutant.apply(before), "utf-8")
        try:
            failure = next(filter(None, map(self.pytest, tests)), "")
        finally:
            file.write_text(before, "utf-8")
        return ("noticed" if failure else "survived"), failure


def run_all(chosen: list[Mutant], options: argparse.Namespace) -> dict[Mutant, str]:
    """Run mutants until `--minutes` have passed, print a line for each, and return their outcomes."""
    outcomes, begin = dict[Mutant, str](), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        free: SimpleQueue[Worker] = SimpleQueue()
        for number in range(options.workers):
            free.put(Worker(Path(folder) / str(number), options.thorough))

        def run(index: int, mutant: Mutant) -> None:
            if time.monotonic() - begin >= 60.0 * options.minutes:
                return
            worker = free.get()
            try:
                outcomes[mutant], failure = worker.run(mutant)
            finally:
                free.put(worker)
            print(f"{index}: {mutant}: {outcomes[mutant]} {failure} ({time.monotonic() - begin:.0f} s)", flush=True)

        with ThreadPoolExecutor(options.workers) as pool:
            list(pool.map(run, range(options.first, options.first + len(chosen)), chosen))
    return outcomes


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=60, help="number of mutants")
    parser.add_argument("--first", type=int, default=0, help="index of the first mutant")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no mutant after this time")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--thorough", action="store_true", help="run slow tests, too: minutes for each survivor")
    parser.add_argument("--show", action="store_true", help="print the mutants, and run nothing")
    options = parser.parse_args()
    if min(options.count, options.workers) < 1 or options.first < 0:
        parser.error("--count and --workers must be at least 1, and --first must be at least 0")
    everything = sample(options.seed)
    chosen = everything[options.first : options.first + options.count]
    if options.show:
        print(*chosen, f"{len(everything)} changes of {len({mutant.path for mutant in everything})} files", sep="\n")
        return
    outcomes = run_all(chosen, options)
    counts = Counter(outcomes.values())
    found = ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome])
    print(f"{len(outcomes)} mutants: {found}", *(mutant for mutant in outcomes if outcomes[mutant] == "survived"), sep="\n")


if __name__ == "__main__":
    main()
