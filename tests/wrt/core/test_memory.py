"""What is free is told by the system, by control groups and by limits, and can be overruled."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.data import ROOT
from wrt.core import memory
from wrt.core.errors import InputError


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WRT_MEMORY", raising=False)


def test_it_is_at_most_what_the_machine_has() -> None:
    assert 2**26 < memory.available() <= os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@pytest.mark.parametrize(("text", "size"), [("24G", 24 * 2**30), ("24 GiB", 24 * 2**30), ("100", 100), ("1.5m", 1.5 * 2**20)])
def test_it_can_be_said(text: str, size: float, say_memory: Callable[[str], None]) -> None:
    say_memory(text)
    assert memory.available() == size


@pytest.mark.parametrize("text", ["much", "-1", "1e9", "G", "10 P"])
def test_what_is_no_size(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WRT_MEMORY", text)
    with pytest.raises(InputError, match="WRT_MEMORY: must be a number of bytes"):
        memory.available()


def test_a_refusal_tells_both_numbers(say_memory: Callable[[str], None]) -> None:
    say_memory("1G")
    memory.require(2.0**30, "it")
    with pytest.raises(InputError, match=r"^it takes 1\.5 GiB of memory; 1\.0 GiB are free \(WRT_MEMORY can say otherwise\)$"):
        memory.require(1.5 * 2**30, "it")


def test_what_is_said_is_for_all_that_the_process_takes(say_memory: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    say_memory("1G")
    monkeypatch.setattr(memory, "resident", lambda: memory._AT_START + 0.75 * 2**30)
    assert memory.available() == 2**28
    with pytest.raises(InputError, match=r"^it takes 0\.3 GiB of memory; 0\.2 GiB are free"):
        memory.require(0.3 * 2**30, "it")
    monkeypatch.setattr(memory, "resident", lambda: memory._AT_START + 2.0**31)
    assert memory.available() == 0.0
    monkeypatch.setattr(memory, "resident", lambda: 0.0)  # the system does not tell, or it has been given back
    assert memory.available() == 2**30


def test_resident_is_what_is_in_use() -> None:
    if not Path("/proc/self/statm").exists():
        pytest.skip("only Linux tells")
    before = memory.resident()
    kept = b"x" * (100 << 20)
    assert 0.9 * len(kept) < memory.resident() - before < 1.2 * len(kept)


def test_the_limit_of_address_space_counts() -> None:
    code = ("import resource; resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30)); from wrt.core.memory import available;"
            " print(available())")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True,
                          env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    assert 2**26 < float(done.stdout) < 2**30


@pytest.mark.parametrize(("line", "root", "files"), [
    ("0::/a/b", "", {"memory.max": "max", "memory.current": "5"}),
    ("4:memory:/a/b", "memory", {"memory.limit_in_bytes": "9223372036854771712", "memory.usage_in_bytes": "5"}),
])
def test_control_groups_and_those_that_hold_them_count(line: str, root: str, files: dict[str, str], tmp_path: Path,
                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    limit, use = files
    cache = "inactive_file" if root == "" else "total_inactive_file"
    for name, most in (("a/b", files[limit]), ("a", "1000"), (".", files[limit])):
        folder = tmp_path / "tree" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / limit).write_text(most + "\n")
        (folder / use).write_text("700\n")
        (folder / "memory.stat").write_text(f"anon 3\n{cache} 200\n")
    monkeypatch.setattr(memory, "_GROUPS", {root: (tmp_path / "tree", limit, use, cache)})
    read_text = Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda self: line + "\n" if str(self) == "/proc/self/cgroup" else read_text(self))
    assert memory.available() == 1000 - 700 + 200
