"""Renders by threads, processes or several devices have the same bits as a render on one device."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data import ROOT
from tests.device import NAME
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE, same
from wrt.io.load import load_scene
from wrt.picture.film import Film
from wrt.renderer import workers
from wrt.renderer.options import Options, Progress
from wrt.renderer.prepare import Prepared
from wrt.renderer.render import render
from wrt.renderer.workers import INSTALLED
from wrt.scene.model import digest

# The picture is smaller than the smallest default tile, so tile_size is set.
HOW: dict[str, Any] = {"tile_size": 16}
LAYERS = ["depth", "normal", "material_id"]


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov=LAYERS)


@pytest.fixture
def threads() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.fixture(autouse=True)
def nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this process a worker without cached scenes."""
    monkeypatch.setattr(workers, "_ready", type(workers._ready)())


class Deaf(Executor):
    """An executor that does not state its number of workers, and runs each job when it is submitted."""

    def __init__(self) -> None:
        self.packages = self.jobs = 0
        self.forgets = False

    def submit(self, function: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
        self.packages += arguments[1] is not None
        self.jobs += 1
        if self.forgets and self.jobs % 7 == 3:  # as a restarted worker does
            workers._ready.clear()
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def test_several_devices(whole: Film) -> None:
    film = render(SCENE, aov=LAYERS, devices=["cpu", "cpu"], **HOW)
    assert same(film, whole)
    assert set(film.stats["workers"]) == {"cpu (0)", "cpu (1)"} and film.metadata["device"] == "cpu,cpu"
    assert film.stats["accel"]["nodes"] == whole.stats["accel"]["nodes"]
    assert film.stats["seconds"].keys() == whole.stats["seconds"].keys()


@pytest.mark.parametrize("options", [{"tile_size": 7, "pass_size": 5}, {"crop": (5, 3, 40, 30)}, {"target_error": 0.02}])
def test_threads(options: dict[str, Any], threads: Executor) -> None:
    assert same(render(SCENE, executor=threads, aov="depth", **options), render(SCENE, aov="depth", **options))


def test_processes(whole: Film) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, context, initializer=die_late, initargs=(context.Barrier(2),)) as pool:
        film = render(SCENE, aov=LAYERS, executor=pool, **HOW)
        assert same(film, whole)
        assert len(film.stats["workers"]) == 2 and f":{os.getpid()}" not in "".join(film.stats["workers"])
        with refused("executor", "terminated abruptly"):
            render(SCENE, executor=pool, spp=1 << 16, **HOW)


def die_late(started: Barrier) -> None:
    """Run in a worker process: the process works once all have started, and is killed at sample 64 of a tile."""
    started.wait(60.0)
    trace = Prepared.trace_tile

    def deadly(self: Prepared, work: Any, *rest: Any) -> Any:
        if work.first >= 64:
            os.kill(os.getpid(), signal.SIGKILL)
        return trace(self, work, *rest)

    Prepared.trace_tile = deadly  # type: ignore[method-assign]


def test_an_executor_that_tells_nothing_gets_the_scene_once(whole: Film) -> None:
    executor = Deaf()
    assert same(render(SCENE, executor=executor, aov=LAYERS, **HOW), whole)
    first = executor.packages
    assert 1 <= first <= workers.QUEUED * workers.SLOTS  # calls that were submitted before a worker had the scene
    render(SCENE, executor=executor, aov=LAYERS, **HOW)
    assert executor.packages == first
    executor.forgets = True
    assert same(render(SCENE, executor=executor, aov=LAYERS, **HOW), whole) and executor.packages > first


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
@pytest.mark.parametrize("path", sorted((ROOT / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenes_can_be_sent(path: Path) -> None:
    scene = load_scene(path)
    back = pickle.loads(pickle.dumps(scene))
    assert digest(back) == digest(scene) and back.settings == scene.settings
    assert [digest(camera) for camera in back.cameras] == [digest(camera) for camera in scene.cameras]


# --- what belongs to a render ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["executor", "devices"])
def test_an_interrupted_render_keeps_whole_tiles(where: str, threads: Executor) -> None:
    def stop(progress: Progress) -> None:
        if progress.done > 0:
            os.kill(os.getpid(), signal.SIGINT)

    how: dict[str, Any] = {"executor": threads} if where == "executor" else {"devices": ["cpu", "cpu"]}
    film = render(SCENE, spp=1 << 16, size=(200, 150), progress=stop, pass_size=4, **how, **HOW)
    assert film.stats["interrupted"] and 0 < film.stats["samples"] < 200 * 150 << 16
    spp = int(film.samples.max())
    done = film.samples == spp
    assert np.array_equal(film.pixels[done], render(SCENE, spp=spp, size=(200, 150)).pixels[done])


def test_a_checkpoint_from_threads_is_finished_by_others_and_back(tmp_path: Path, threads: Executor) -> None:
    whole, path = render(SCENE, aov="depth"), tmp_path / "a.checkpoint"
    for step, how in ((6, {}), (12, {"executor": threads}), (24, {"devices": [NAME, NAME]})):
        film = render(SCENE, spp=step, aov="depth", checkpoint=path, resume=True, checkpoint_every=1e-9, **how, **HOW)
    assert same(film, whole) and film.stats["resumed"]["samples"] == 12


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_a_worker_s_error_is_told_and_the_work_is_saved(tmp_path: Path, threads: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    trace, path = Prepared.trace_tile, tmp_path / "a.checkpoint"

    def fails(self: Prepared, work: Any, *rest: Any) -> Any:
        if work.first >= 1:
            raise ZeroDivisionError("as it happens")
        return trace(self, work, *rest)

    monkeypatch.setattr(Prepared, "trace_tile", fails)
    with pytest.raises(ZeroDivisionError, match="as it happens"):
        render(SCENE, executor=threads, checkpoint=path, **HOW)
    monkeypatch.setattr(Prepared, "trace_tile", trace)
    film = render(SCENE, executor=threads, checkpoint=path, resume=True, **HOW)
    assert film.stats["resumed"]["samples"] == 1 and same(film, render(SCENE))


@pytest.mark.parametrize("part", [*INSTALLED, "kernels"])
def test_a_worker_of_another_installation_is_refused(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(Deaf):
        def submit(self, function: Any, key: str, package: Any, *arguments: Any, **_: Any) -> Future[Any]:  # type: ignore[override]
            if package is not None:
                change = {"kernels": "0" * 64} if part == "kernels" else {"installed": {**INSTALLED, part: "0"}}
                package = package._replace(**change)
            return super().submit(function, key, package, *arguments)

    with refused(what="other kernels" if part == "kernels" else f"{part} {INSTALLED[part]} (here 0)"):
        render(SCENE, executor=Other())


def test_all_code_counts_wherever_the_kernels_stand(tmp_path: Path) -> None:
    """A checkout has kernels/ beside the package, a wheel in it. Both have the same digest, so that they can work together."""
    shutil.copytree(ROOT / "wrt", tmp_path / "wrt", ignore=shutil.ignore_patterns("__pycache__", "kernels"))
    shutil.copytree(ROOT / "kernels", tmp_path / "wrt" / "kernels", ignore=shutil.ignore_patterns("__pycache__"))

    def digest_there() -> str:
        code = "from wrt.renderer.workers import INSTALLED; print(INSTALLED['code of wrt'])"
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)},
                              capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert digest_there() == INSTALLED["code of wrt"]
    with open(tmp_path / "wrt" / "kernels" / "shade" / "film.h", "a", encoding="utf-8") as file:
        file.write("// one more line\n")
    assert digest_there() != INSTALLED["code of wrt"]


def test_workers_on_devices_of_several_kinds_are_refused(threads: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(workers, "kind_of", lambda device: asked.append("") or f"cuda, sm_{80 + (len(asked) > 1)}")
    with refused(what="several kinds"):
        render(SCENE, executor=threads, **HOW)


@pytest.mark.parametrize(("options", "argument"), [
    ({"devices": []}, "devices"), ({"devices": ["cpu", "gpu"]}, "device"), ({"devices": [1]}, "devices[0]"),
    ({"executor": "tcp://127.0.0.1:1"}, "executor"), ({"executor": 3}, "executor"), ({"executor": Deaf(), "devices": ["cpu"]}, "devices"),
])
def test_bad_options(options: dict[str, Any], argument: str) -> None:
    with refused(argument):
        Options(**options)
