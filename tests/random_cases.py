"""The command line of the random tests: check many random cases on all processors, or one case again."""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

Check = Callable[[int, int], str]  # takes a group and a seed; returns a description of the differences, "" without any


def checked(check: Check, group: int, seed: int) -> str:
    """Return the result of `check`, or a traceback if it raises."""
    try:
        return check(group, seed)
    except Exception:
        return traceback.format_exc()


def checked_group(check: Check, group: int, count: int) -> tuple[int, int, list[tuple[int, str]]]:
    """Return the group, `count`, and a (seed, description) pair for each case that differs."""
    found = ((seed, checked(check, group, seed)) for seed in range(count))
    return group, count, [(seed, what) for seed, what in found if what]


def main(about: str, check: Check, per_group: int) -> None:
    """Check `--count` cases in groups of `per_group`, from group `--seed` on, or the case `--only`. Exit with 1 if any differs."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="number of cases [default: 10000]")
    parser.add_argument("--seed", type=int, default=0, help="number of the first group [default: 0]")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="number of processes [default: number of processors]")
    parser.add_argument("--only", type=int, nargs=2, metavar=("GROUP", "SEED"), help="check this case only")
    options = parser.parse_args()
    if options.only:
        sys.exit(check(*options.only) or 0)
    sys.exit(1 if run(check, per_group, options) else 0)


def run(check: Check, per_group: int, options: argparse.Namespace) -> int:
    """Print the differing cases and the progress; return the number of cases that differ."""
    begin, done, wrong = time.monotonic(), 0, 0
    jobs = [(check, options.seed + i, min(per_group, options.count - first))
            for i, first in enumerate(range(0, options.count, per_group))]
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for job in as_completed([pool.submit(checked_group, *each) for each in jobs]):
            group, count, found = job.result()  # raises where a process has crashed
            wrong += len(found)
            for seed, what in found:
                print(f"differs: --only {group} {seed}: {what}", flush=True)
            done += count
            print(f"{done} of {options.count} cases, {wrong} differ, {time.monotonic() - begin:.0f} s", flush=True)
    return wrong
