"""Long renders on the command line: kills, checkpoints, time limits, and pictures that cannot be written."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.device import NAME
from wrt.core.errors import InputError
from wrt.picture import film
from wrt.picture.image import read_channels
from wrt.renderer.checkpoint import read

SMALL = ("--size", "32x18", "--spp", 4)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run each test in a new folder that contains box.obj; temporary files go into its folder tmp."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    Path("box.obj").write_text(BOX_OBJ)
    return tmp_path


def new_files() -> set[str]:
    return {path.name for path in Path().iterdir()} - {"box.obj", "tmp"}


def channels(name: str) -> dict[str, bytes]:
    return {channel: array.tobytes() for channel, array in read_channels(name).items()}


# --- kill -9 ----------------------------------------------------------------------------------------------------------

RENDER = ("render", "box.obj", "--size", "160x90", "--spp", 600, "-o", "a.exr", "--aov", "depth", "--device", NAME)
# Runs the command line, and prints the stage and the seconds of tracing at each call of `progress`.
TELLING = """
import sys, wrt.renderer.progress
from contextlib import contextmanager
@contextmanager
def reporter(quiet):
    yield lambda progress: print(progress.stage, progress.seconds, file=sys.stderr, flush=True)
wrt.renderer.progress.progress_reporter = reporter
from wrt.cli.main import main
main()
"""


def killed_when(traced: float, later: float, *arguments: object) -> None:
    """Run the command, and kill it (-9) `later` seconds after it reports `traced` seconds of tracing."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    with subprocess.Popen([sys.executable, "-c", TELLING, *map(str, arguments)], text=True, stderr=subprocess.PIPE,
                          stdout=subprocess.DEVNULL, env=environment) as running:
        assert running.stderr is not None
        for line in running.stderr:
            if line.startswith("trace ") and float(line.split()[1]) >= traced:
                time.sleep(later)
                running.kill()


def test_kills_change_nothing() -> None:
    assert run(*RENDER).code == 0
    expected = channels("a.exr")
    Path("a.exr").unlink()
    rng = random.Random(7)
    options = (*RENDER, "--checkpoint", "0.2s", "--resume")
    for i in range(3):
        killed_when(0.2 * i + 0.2 * rng.random(), 0.1 * rng.random(), *options)  # the render takes a second or two
        if Path("a.exr.checkpoint").exists():
            assert read("a.exr.checkpoint").seconds > 0.0  # the file is complete
        if Path("a.exr").exists():  # a fast machine finished before the kill
            assert channels("a.exr") == expected
            Path("a.exr").unlink()
        for left in Path().glob(".wrt-*"):  # left by a kill during the writing of a checkpoint
            left.unlink()
        assert new_files() <= {"a.exr.checkpoint"}
    assert run(*options).code == 0
    assert channels("a.exr") == expected and new_files() == {"a.exr"}


# --- the command line -------------------------------------------------------------------------------------------------


def test_time_limits_and_resumes(folder: Path) -> None:
    options = ("render", "box.obj", "--size", "64x36", "--time-limit", "0.2s", "-o", "a.exr", "--checkpoint-file", "b")
    first = run(*options, "--spp", 1 << 20)
    assert first.code == 0 and f"{folder.resolve() / 'b'}: --resume continues from this checkpoint" in first.err
    assert new_files() == {"a.exr", "b"}
    before = int(read_channels("a.exr")["samples"].max())
    again = run(*options, "--spp", 1 << 20, "--resume")
    assert again.code == 0 and f"{before} spp from the checkpoint" in again.err
    after = read_channels("a.exr")["samples"]
    assert before < after.min() == after.max()
    whole = run("render", "box.obj", "--size", "64x36", "--spp", int(after.max()), "-o", "c.exr")
    assert whole.code == 0 and channels("a.exr") == channels("c.exr")


@pytest.mark.parametrize(("arguments", "message"), [
    (["--checkpoint", "soon"], "write 30s, 5m or 1h"), (["--checkpoint", "0s"], "checkpoint_every must be more than 0"),
    (["--checkpoint-file", "./a.png"], "a.png: is the picture; a checkpoint needs a file of its own"),
    (["--checkpoint-file", "nowhere/c"], "nowhere/c: its folder does not exist"),
    (["--checkpoint-file", "box.obj"], "box.obj: exists already; resume it (--resume"),
    (["--checkpoint-file", "box.obj", "--resume"], "box.obj: is no checkpoint of this version"),
])
def test_wrong_checkpoint_options_are_refused_early(arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.renderer.render.prepare", lambda *_: pytest.fail("the work began"))
    result = run("render", "box.obj", *SMALL, "-o", "a.png", *arguments)
    assert result.code == 2 and message in result.err and result.out == "" and new_files() == set()
    assert "error: box.obj: /" not in result.err  # the error does not name the scene
    assert Path("box.obj").read_text() == BOX_OBJ


def test_the_checkpoint_of_a_picture_that_cannot_be_written_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: film.Film, path: Any, **options: Any) -> list[Path]:
        raise InputError("cannot be written: No space left on device", path=path)

    with monkeypatch.context() as patch:
        patch.setattr(film.Film, "save", failing)
        result = run("render", "box.obj", *SMALL, "-o", "a.exr", "--aov", "depth", "--checkpoint", "60s")
    assert result.code == 2 and result.errors == ["error: a.exr: cannot be written: No space left on device"]
    assert new_files() == {"a.exr.checkpoint"} and read("a.exr.checkpoint").samples == (4, 4)
    again = run("render", "box.obj", *SMALL, "-o", "b.exr", "--aov", "depth", "--checkpoint-file", "a.exr.checkpoint", "--resume")
    assert again.code == 0 and "from the checkpoint" in again.err and new_files() == {"b.exr"}
