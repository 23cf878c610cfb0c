"""The command of the random tests: many cases on all processors, and one of them again."""

from __future__ import annotations

import argparse
import os
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

Check = Callable[[int, int], str]  # of a group and a seed: what differs


def checked(check: Check, group: int, seed: int) -> str:
    """As check; an error counts as a difference."""
    try:
        return check(group, seed)
    except Exception:
        return traceback.format_exc()


def checked_group(check: Check, group: int, count: int) -> tuple[int, int, list[tuple[int, str]]]:
    """The group, the number of its cases, and the seeds that differ, and in what."""
    found = ((seed, checked(check, group, seed)) for seed in range(count))
    return group, count, [(seed, what) for seed, what in found if what]


def main(about: str, check: Check, per_group: int) -> None:
    """Check `--count` cases from group `--seed` on, `per_group` a group, or the one of `--only`; exit with 1 where one differs."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="cases [default: 10000]")
    parser.add_argument("--seed", type=int, default=0, help="number of the first group [default: 0]")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes [default: one a processor]")
    parser.add_argument("--only", type=int, nargs=2, metavar=("GROUP", "SEED"), help="one case")
    options = parser.parse_args()
    if options.only:
        sys.exit(check(*options.only) or 0)
    sys.exit(1 if run(check, per_group, options) else 0)


def run(check: Check, per_group: int, options: argparse.Namespace) -> int:
    """How many cases differ."""
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
