"""Distributed renders by threads, processes or several devices have the same bits as a render on one device."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing.synchronize import Barrier
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.device import NAME
from tests.refused import refused
from tests.wrt.renderer.test_checkpoint import SCENE, same
from wrt import profile
from wrt.core.errors import SceneWarning
from wrt.picture.film import Film
from wrt.renderer import upload
from wrt.renderer.animate import Animation, animate
from wrt.renderer.distributed import renderer as module
from wrt.renderer.distributed import workers
from wrt.renderer.distributed.installed import CODE, INSTALLED, difference
from wrt.renderer.options import Options, Progress
from wrt.renderer.prepare import Prepared
from wrt.renderer.render import render
from wrt.scene.materials import Material
from wrt.scene.model import Object
from wrt.scene.shapes import box

# The picture is smaller than the smallest default tile, so tile_size is set.
HOW: dict[str, Any] = {"tile_size": 16}


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov=["depth", "normal", "material_id"])


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
        self.packages = 0

    def submit(self, function: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
        self.packages += arguments[1] is not None
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def test_several_devices(whole: Film) -> None:
    film = render(SCENE, aov=["depth", "normal", "material_id"], devices=["cpu", "cpu"], **HOW)
    assert same(film, whole)
    assert set(film.stats["workers"]) == {"cpu (0)", "cpu (1)"} and film.metadata["device"] == "cpu,cpu"
    assert film.stats["accel"]["nodes"] == whole.stats["accel"]["nodes"]
    assert film.stats["seconds"].keys() == whole.stats["seconds"].keys()


@pytest.mark.parametrize("options", [{}, {"tile_size": 7, "pass_size": 5}, {"crop": (5, 3, 40, 30)}, {"target_error": 0.02},
                                     {"seed": 7, "crop": (60, 33, 61, 34)}])
def test_threads(options: dict[str, Any], threads: Executor) -> None:
    assert same(render(SCENE, executor=threads, aov="depth", **options), render(SCENE, aov="depth", **options))


def test_processes(whole: Film) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, context, initializer=die_late, initargs=(context.Barrier(2),)) as pool:
        film = render(SCENE, aov=["depth", "normal", "material_id"], executor=pool, **HOW)
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


def test_a_pool_that_waits_for_a_dead_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's process pool does so if a process is killed while it writes a reply."""
    monkeypatch.setattr(workers, "DEAD_SECONDS", 0.2)

    class Waiting(Deaf):
        _processes = {1: SimpleNamespace(is_alive=lambda: False)}

        def submit(self, function: Any, /, *arguments: Any, **_: Any) -> Future[Any]:
            return Future()

    with refused("executor", "process"):
        render(SCENE, executor=Waiting())


def test_an_executor_that_tells_nothing_gets_the_scene_once(whole: Film) -> None:
    executor = Deaf()
    assert same(render(SCENE, executor=executor, aov=["depth", "normal", "material_id"], **HOW), whole)
    first = executor.packages
    assert 1 <= first <= workers.QUEUED * workers.SLOTS  # calls that were submitted before a worker had the scene
    render(SCENE, executor=executor, aov=["depth", "normal", "material_id"], **HOW)
    assert executor.packages == first


def test_a_worker_that_forgot_asks_again(whole: Film, monkeypatch: pytest.MonkeyPatch) -> None:
    """A restarted worker would do so."""

    def forgetful(*arguments: Any, **rest: Any) -> Any:
        if forgetful.calls % 7 == 3:  # type: ignore[attr-defined]
            workers._ready.clear()
        forgetful.calls += 1  # type: ignore[attr-defined]
        return call(*arguments, **rest)

    call, forgetful.calls = workers.call, 0  # type: ignore[attr-defined]
    monkeypatch.setattr(workers, "call", forgetful)
    assert same(render(SCENE, executor=Deaf(), aov=["depth", "normal", "material_id"], **HOW), whole)
    assert forgetful.calls > 50  # type: ignore[attr-defined]


def test_few_scenes_are_kept(threads: Executor) -> None:
    for color in (0.1, 0.2, 0.3):
        material = Material(albedo=(color, 0.5, 0.5))
        render(replace(SCENE, objects=(Object(box(), (material,)),)), executor=threads, spp=1)
    assert len(workers._ready) == workers.CACHED


# --- what belongs to a render ----------------------------------------------------------------------------------------


def test_the_picture_grows(threads: Executor) -> None:
    seen: list[tuple[int, float]] = []

    def progress(progress: Progress) -> None:
        if progress.picture is not None:
            picture = progress.picture()
            seen.append((progress.done, float((picture.samples > 0).mean())))
            assert progress.done == picture.samples.sum()

    film = render(SCENE, executor=threads, progress=progress, size=(160, 100), spp=64, **HOW)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen) and seen[-1] == (film.samples.sum(), 1.0)


@pytest.mark.parametrize("where", ["executor", "devices"])
def test_an_interrupted_render_keeps_whole_tiles(where: str, threads: Executor) -> None:
    def stop(progress: Progress) -> None:
        if progress.done > 0:
            raise KeyboardInterrupt

    how: dict[str, Any] = {"executor": threads} if where == "executor" else {"devices": ["cpu", "cpu"]}
    film = render(SCENE, spp=1 << 16, size=(200, 150), progress=stop, pass_size=4, **how, **HOW)
    assert film.stats["interrupted"] and 0 < film.stats["samples"] < 200 * 150 << 16
    spp = int(film.samples.max())
    done = film.samples == spp
    assert np.array_equal(film.pixels[done], render(SCENE, spp=spp, size=(200, 150)).pixels[done])


def test_ctrl_c(threads: Executor) -> None:
    def press(progress: Progress) -> None:
        if progress.stage == "trace":
            os.kill(os.getpid(), signal.SIGINT)

    film = render(SCENE, spp=1 << 16, size=(200, 150), executor=threads, progress=press)
    assert film.stats["interrupted"] and film.stats["signal"] == signal.SIGINT


def test_time_limit(threads: Executor) -> None:
    film = render(SCENE, spp=1 << 16, executor=threads, time_limit=0.2)
    assert film.stats["timed_out"] and film.samples.min() >= 1


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


def other(part: str, **changes: str) -> dict[str, Any]:
    """Return a package from another installation."""
    return {"installed": {**INSTALLED, part: INSTALLED[part] | changes}}


@pytest.mark.parametrize(("change", "what"), [
    (other("versions", wrt="0.0.9"), f"wrt {wrt.__version__} (here 0.0.9)"),
    (other("versions", NumPy="1.0"), f"NumPy {np.__version__} (here 1.0)"),
    (other("versions", Python="3.4"), "(here 3.4)"),
    (other("files", **{"io/obj.py": "0"}), "(io/obj.py)"),
    (other("files", **{"kernels/new.py": "0"}), "(kernels/new.py)"),
    (other("files", **{name: "0" for name in ("a.py", "b.py", "c.py", "d.py")}), "(a.py, b.py, c.py and 1 more)"),
    ({"kernels": "0" * 64}, "other kernels"),
], ids=range(7))
def test_a_worker_of_another_installation_is_refused(change: dict[str, str], what: str, threads: Executor,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    unpacked = workers._unpacked
    monkeypatch.setattr(workers, "_unpacked", lambda package: unpacked({**package, **change}))
    with refused(what=what):
        render(SCENE, executor=threads)


def test_all_code_counts_wherever_the_kernels_stand(tmp_path: Path) -> None:
    """A checkout has kernels/ beside the package, a wheel in it. Both have the same names and digests, so that they can work together."""
    shutil.copytree(ROOT / "wrt", tmp_path / "wrt", ignore=shutil.ignore_patterns("__pycache__", "kernels"))
    shutil.copytree(ROOT / "kernels", tmp_path / "wrt" / "kernels", ignore=shutil.ignore_patterns("__pycache__"))
    code = "import json; from wrt.renderer.distributed.installed import INSTALLED; print(json.dumps(INSTALLED))"
    done = subprocess.run([sys.executable, "-c", code],
                          cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=True)
    wheel = json.loads(done.stdout)
    assert difference(INSTALLED, wheel) == "" and list(wheel["files"]) == list(INSTALLED["files"])
    assert {"accel/store.py", "lab/bench/timing.py", "kernels/loops/one_ray.py"} <= INSTALLED["files"].keys()
    assert len(INSTALLED["files"]) == sum(path.suffix in CODE for folder in ("wrt", "kernels")
                                          for path in (ROOT / folder).rglob("*"))


@pytest.mark.parametrize("alike", [1, 5])
def test_workers_on_devices_of_several_kinds_are_refused(alike: int, threads: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both the first workers and workers that connect later are compared."""
    asked: list[str] = []
    monkeypatch.setattr(workers, "kind_of", lambda device: asked.append("") or f"cuda, sm_{80 + (len(asked) > alike)}")
    with refused(what="several kinds"):
        render(SCENE, executor=threads, **HOW)


def test_what_is_not_a_picture_takes_neither(threads: Executor) -> None:
    for how in ({"executor": threads}, {"devices": ["cpu", "cpu"]}):
        with refused(what="runs on one device"):
            next(animate(SCENE, Animation(frames=2), Options(**how)))


@pytest.mark.parametrize(("options", "argument"), [
    ({"devices": []}, "devices"), ({"devices": ["cpu", "gpu"]}, "device"), ({"devices": [1]}, "devices[0]"),
    ({"executor": "tcp://127.0.0.1:1"}, "executor"), ({"executor": 3}, "executor"), ({"executor": Deaf(), "devices": ["cpu"]}, "devices"),
])
def test_bad_options(options: dict[str, Any], argument: str) -> None:
    with refused(argument):
        Options(**options)


def test_one_device_may_be_given_by_its_name() -> None:
    assert Options(devices="cpu").devices == ("cpu",)


def test_a_profile_has_no_executor(threads: Executor) -> None:
    with refused("executor"):
        profile(SCENE, executor=threads)


def test_a_closed_executor(threads: Executor) -> None:
    threads.shutdown()
    with refused("executor", "cannot schedule"):
        render(SCENE, executor=threads)


def test_what_a_picture_leaves_out_is_told_once(threads: Executor, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in (module, upload):
        monkeypatch.setattr(place, "warn_left_out", lambda scene: warnings.warn("left out", SceneWarning, stacklevel=1))
    for how in ({"executor": threads}, {"devices": ["cpu", "cpu"]}):
        with pytest.warns(SceneWarning, match="left out") as told:
            render(SCENE, spp=1, **how)
        assert len(told) == 1
