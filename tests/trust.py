"""Figures about the suite itself: `python -m tests.trust` prints docs/testing.md's table, and `--write` puts it there.

Tests are counted now. Long runs (`python -m tests.fuzz`, `tests.soak`, `tests.mutants`) store their figures in tests/trust.json with
`--record`."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from datetime import date
from pathlib import Path

from tests.data import ROOT

STORED = Path(__file__).with_suffix(".json")
PAGE = ROOT / "docs" / "testing.md"
BEGIN, END = "<!-- python -m tests.trust --write -->\n", "<!-- end -->\n"


def record(run: str, what: str, found: str) -> None:
    """Store the figures of a long run: what was done, and what was found."""
    stored = json.loads(STORED.read_text("utf-8")) if STORED.exists() else {}
    stored[run] = {"date": date.today().isoformat(), "what": what, "found": found}
    STORED.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n", "utf-8")


def collected() -> tuple[int, int]:
    """Return the numbers of tests that `pytest` runs, and of further, slow ones."""
    # Collecting compiles every test; rewriting their assertions, too, would double the work.
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-n", "0", "--assert=plain", "tests"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    found = re.search(r"(\d+)/(\d+) tests collected", done.stdout)
    assert found, done.stdout[-500:]
    return int(found[1]), int(found[2]) - int(found[1])


def table() -> str:
    """Return a Markdown table, a row for each run."""
    usual, slow = collected()
    rows = [("`pytest`", date.today().isoformat(), f"{usual:,} tests", "CI fails if one fails"),
            ("`pytest -m slow`", date.today().isoformat(), f"{slow:,} more tests", "by hand")]
    rows += [(f"`python -m tests.{run}`", each["date"], each["what"], each["found"])
             for run, each in json.loads(STORED.read_text("utf-8")).items()]
    return "| run | date | what | found |\n|---|---|---|---|\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)


def main() -> None:
    text = table()
    if sys.argv[1:] == ["--write"]:
        page = PAGE.read_text("utf-8")
        PAGE.write_text(re.sub(f"(?s)(?<={re.escape(BEGIN)}).*(?={re.escape(END)})", lambda _: text, page), "utf-8")
    else:
        print(text, end="")


if __name__ == "__main__":
    main()
