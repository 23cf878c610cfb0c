"""Renders by workers have the same bits as a render on one device. The workers are threads of this process behind a Client's methods."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.data import ROOT
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


class Threads(ThreadPoolExecutor):
    """What wrt calls of a dask.distributed.Client, with two threads as workers; test_cluster.py has real ones."""

    asynchronous = False
    scheduler = SimpleNamespace(address="here")
    changes: Mapping[str, Any] = MappingProxyType({})  # of the package that is sent

    def wait_for_workers(self, n: int, timeout: float) -> None: ...

    def run(self, function: Any, *arguments: Any, on_error: str) -> dict[str, Any]:
        return {"here": INSTALLED}

    def scatter(self, packages: list[Any], broadcast: bool, hash: bool) -> list[Any]:
        return [package._replace(**self.changes) for package in packages]

    def nthreads(self) -> dict[str, int]:
        return {"here": 2}

    def get_executor(self, pure: bool) -> Threads:
        return self


@pytest.fixture
def threads() -> Iterator[Threads]:
    with Threads(2) as pool:
        yield pool


@pytest.fixture(autouse=True)
def nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this process a worker without cached scenes."""
    monkeypatch.setattr(workers, "_ready", type(workers._ready)())


@pytest.mark.parametrize("options", [{"tile_size": 7, "pass_size": 5}, {"crop": (5, 3, 40, 30)}, {"target_error": 0.02}])
def test_threads(options: dict[str, Any], threads: Threads) -> None:
    assert same(render(SCENE, executor=threads, aov="depth", **options), render(SCENE, aov="depth", **options))


@pytest.mark.filterwarnings("ignore::wrt.core.errors.SceneWarning")
@pytest.mark.parametrize("path", sorted((ROOT / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_scenes_can_be_sent(path: Path) -> None:
    scene = load_scene(path)
    back = pickle.loads(pickle.dumps(scene))
    assert digest(back) == digest(scene) and back.settings == scene.settings
    assert [digest(camera) for camera in back.cameras] == [digest(camera) for camera in scene.cameras]


# --- what belongs to a render ----------------------------------------------------------------------------------------


def test_an_interrupted_render_keeps_whole_tiles(threads: Threads) -> None:
    def stop(progress: Progress) -> None:
        if progress.done > 0:
            os.kill(os.getpid(), signal.SIGINT)

    film = render(SCENE, spp=1 << 16, size=(200, 150), progress=stop, pass_size=4, executor=threads, **HOW)
    assert film.stats["interrupted"] and 0 < film.stats["samples"] < 200 * 150 << 16
    spp = int(film.samples.max())
    done = film.samples == spp
    assert np.array_equal(film.pixels[done], render(SCENE, spp=spp, size=(200, 150)).pixels[done])


def test_a_checkpoint_from_threads_is_finished_by_others_and_back(tmp_path: Path, threads: Threads) -> None:
    whole, path = render(SCENE, aov="depth"), tmp_path / "a.checkpoint"
    for step, how in ((6, {}), (12, {"executor": threads}), (24, {})):
        film = render(SCENE, spp=step, aov="depth", checkpoint=path, resume=True, checkpoint_every=1e-9, **how, **HOW)
    assert same(film, whole) and film.stats["resumed"]["samples"] == 12


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_a_worker_s_error_is_told_and_the_work_is_saved(tmp_path: Path, threads: Threads, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_a_worker_of_another_installation_is_refused(part: str, threads: Threads, monkeypatch: pytest.MonkeyPatch) -> None:
    change = {"kernels": "0" * 64} if part == "kernels" else {"installed": {**INSTALLED, part: "0"}}
    monkeypatch.setattr(threads, "changes", change)
    with refused(what="other kernels" if part == "kernels" else f"{part} {INSTALLED[part]} (here 0)"):
        render(SCENE, executor=threads)


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


def test_workers_on_devices_of_several_kinds_are_refused(threads: Threads, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(workers, "kind_of", lambda device: asked.append("") or f"cuda, sm_{80 + (len(asked) > 1)}")
    with refused(what="several kinds"):
        render(SCENE, executor=threads, **HOW)


@pytest.mark.parametrize("executor", ["tcp://127.0.0.1:1", 3, ThreadPoolExecutor(1)])
def test_what_is_no_client_is_refused(executor: object) -> None:
    with refused("executor", "dask.distributed.Client"):
        Options(executor=executor)  # type: ignore[arg-type]
