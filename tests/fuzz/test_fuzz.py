"""Readers accept damaged files of every format, or raise InputError; a few seconds of what `python -m tests.fuzz` does at length."""

from __future__ import annotations

import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from tests.data import ROOT
from tests.fuzz.formats import FORMATS, Format, load_accel_only, make_case
from tests.fuzz.seeds import Seed
from tests.fuzz.worker import Judge
from wrt.core.errors import InputError


def judge_of(name: str, folder: Path) -> Judge:
    form = FORMATS[name]
    if name == "accel":  # tracing rays would compile kernels for all structures
        form = Format(form.seeds, form.damaged, load_accel_only)
    return Judge(form, folder)


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    judge = judge_of(name, tmp_path)
    for seed in judge.form.seeds():
        assert judge.read(0, seed) == ""
    sound = judge.outcomes["read"]
    assert sound > 0.7 * len(judge.form.seeds())

    @settings(max_examples=150, deadline=10_000, derandomize=True, database=None, suppress_health_check=list(HealthCheck),
              phases=(Phase.explicit, Phase.generate))
    @given(st.integers(0, 2**64))
    @example(0)
    def check(number: int) -> None:
        assert judge.read(number, make_case(judge.form, random.Random(number))) == ""

    with judge.watching_stderr():
        check()
    assert judge.outcomes["refused"] > 10 and judge.outcomes["read"] > sound + 5


@pytest.mark.parametrize("name", ["toml", "gltf", "obj", "ply", "stl", "image"])
def test_any_bytes_are_read_or_refused(name: str, tmp_path: Path) -> None:
    judge = judge_of(name, tmp_path)

    @settings(max_examples=60, deadline=10_000, derandomize=True, database=None)
    @given(st.sampled_from(judge.form.seeds()), st.binary(max_size=200) | st.text(max_size=100).map(str.encode), st.booleans())
    def check(seed: Seed, data: bytes, behind: bool) -> None:
        assert judge.read(0, Seed(seed.suffix, seed.data[:20] * behind + data)) == ""

    check()


def test_a_defect_is_seen(tmp_path: Path) -> None:
    """The judge reports each way in which a reader can fail."""
    import os
    import warnings

    def reader(path: Path) -> object:
        match path.read_bytes():
            case b"error":
                raise UnicodeDecodeError("x", b"", 0, 1, "y")
            case b"hidden":
                raise InputError("no") from MemoryError()
            case b"memory":
                raise MemoryError
            case b"stderr":
                os.write(2, b"libpng says no\n")
            case b"warning":
                warnings.warn("overflow", RuntimeWarning, stacklevel=1)
            case b"refused":
                raise InputError("no")
        return None

    judge = Judge(Format(list, lambda seed, other, rng: seed, reader), tmp_path)
    with judge.watching_stderr():
        words = ("error", "hidden", "memory", "stderr", "warning", "refused", "fine")
        problems = {word: judge.read(0, Seed(".x", word.encode())) for word in words}
    assert problems.pop("refused") == problems.pop("fine") == ""
    assert [problem.split()[0] for problem in problems.values()] == [
        "UnicodeDecodeError", "InputError", "MemoryError", "stderr", "RuntimeWarning"]
    judge.form = replace(judge.form, names_sizes=True)
    assert judge.read(0, Seed(".x", b"memory")) == "" and judge.outcomes["out of memory"] == 1


def test_the_command_runs_workers(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--inputs", "300", "--format", "ply", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "300 inputs, 0 defects" in done.stdout and not (tmp_path / "out").exists()
