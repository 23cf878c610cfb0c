"""Dask workers in other processes render the same bits as this process, even if some of them are killed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wrt
from tests.command_line import BOX_OBJ
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.refused import Refusal, refused
from tests.wrt.renderer.test_checkpoint import SCENE, same
from wrt.core.errors import InputError
from wrt.picture.film import Film
from wrt.picture.image import read_channels
from wrt.renderer import schedule
from wrt.renderer.distributed import dask as cluster
from wrt.renderer.distributed import workers
from wrt.renderer.options import Progress
from wrt.renderer.render import render

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
dask = pytest.importorskip("dask", reason="needs the extra cluster")

HOW: dict[str, Any] = {"tile_size": 24, "pass_size": 8, "aov": "depth"}  # few tiles, since each call takes a hundredth of a second


@pytest.fixture(scope="module")
def local() -> Iterator[Any]:
    """Start two workers, each a process with one thread."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50) as started:
        yield started


@pytest.fixture
def client(local: Any) -> Iterator[Any]:
    with distributed.Client(local, set_as_default=False) as one:
        one.wait_for_workers(2, timeout=60)  # a killed worker is restarted
        yield one


@pytest.fixture(scope="module")
def whole() -> Film:
    return render(SCENE, aov="depth")


def dies_in_a_tile(flags: list[str]) -> None:
    """Run on a worker: for each flag file, one process is killed while it traces a tile."""
    from wrt.renderer.prepare import Prepared

    trace = Prepared.trace_tile

    def deadly(self: Any, work: Any, *rest: Any) -> Any:
        arrays = trace(self, work, *rest)
        for flag in flags if work.first >= 4 else ():
            try:
                os.close(os.open(flag, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            os.kill(os.getpid(), signal.SIGKILL)
        return arrays

    Prepared.trace_tile = deadly  # type: ignore[method-assign]


def test_the_picture_is_the_same(client: Any, whole: Film) -> None:
    film = render(SCENE, executor=client, **HOW)
    assert same(film, whole)
    assert {int(name.split(":")[1]) for name in film.stats["workers"]} == set(client.run(os.getpid).values())
    again = render(SCENE, executor=client, target_error=0.02, crop=(3, 4, 50, 30), tile_size=24)
    assert same(again, render(SCENE, target_error=0.02, crop=(3, 4, 50, 30)))


@pytest.mark.parametrize("killed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_killed_workers_cost_only_their_tiles(client: Any, whole: Film, tmp_path: Path, killed: int) -> None:
    """If both workers die, the scene is lost, too, and is sent to the restarted workers."""
    flags = [str(tmp_path / str(i)) for i in range(killed)]
    before = set(client.run(os.getpid).values())
    client.run(dies_in_a_tile, flags)
    seen: list[int] = []
    film = render(SCENE, executor=client, progress=lambda progress: seen.append(progress.done), **HOW)
    assert sorted(os.listdir(tmp_path)) == [str(i) for i in range(killed)]
    assert same(film, whole) and seen == sorted(seen)
    assert len(before - set(client.run(os.getpid).values())) == killed


def test_a_worker_that_hangs_does_not_stop_the_time_limit(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "OVERTIME", 2.0)
    monkeypatch.setattr(schedule, "SILENT", 1.0)
    hung = client.run(os.getpid).popitem()[1]
    notes: set[str] = set()

    def hang(progress: Progress) -> None:
        notes.add(progress.note)
        if progress.stage == "trace" and progress.done > pixels:  # after the first pass
            os.kill(hung, signal.SIGSTOP)

    pixels = SCENE.settings.size[0] * SCENE.settings.size[1]
    late = threading.Timer(60.0, os.kill, (hung, signal.SIGCONT))
    late.start()
    try:
        film = render(SCENE, executor=client, spp=1 << 16, time_limit=0.5, progress=hang, tile_size=24, pass_size=8)
        assert not late.finished.is_set()  # the render did not wait for the hanging worker
    finally:
        late.cancel()
        os.kill(hung, signal.SIGCONT)
    assert film.stats["timed_out"] and not film.stats["interrupted"]
    assert any(note.startswith("a worker has not answered for ") for note in notes)
    least = int(film.samples.min())
    alike = film.samples == least
    assert least >= 8 and (film.pixels[alike] == render(SCENE, spp=least).pixels[alike]).all()


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def threads() -> Iterator[Any]:
    """Start a scheduler and a worker in this process, which takes no time."""
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, protocol="tcp://", silence_logs=50,
                                  dashboard_address=":0") as started:
        yield started


def test_an_error_on_a_worker_is_the_one_that_is_raised(client: Any) -> None:
    def fails() -> None:
        from wrt.renderer.prepare import Prepared

        def trace_tile(self: Any, work: Any, *rest: Any) -> Any:
            raise ZeroDivisionError("as it happens") if work.first else InputError("not this scene", path="a.toml")

        Prepared.kept, Prepared.trace_tile = Prepared.trace_tile, trace_tile  # type: ignore

    def works() -> None:
        from wrt.renderer.prepare import Prepared

        Prepared.trace_tile = Prepared.kept  # type: ignore

    client.run(fails)
    try:
        with refused(what="not this scene", path="a.toml"):
            render(SCENE, executor=client)
    finally:
        client.run(works)


@pytest.mark.parametrize(("change", "said"), [
    (lambda: sys.modules["wrt"].__dict__.update(__version__="0.0.9"), (None, "wrt 0.0.9 (here")),
    (lambda: sys.modules.update(kept=sys.modules["wrt"], wrt=None),  # type: ignore
     (None, "lacks this version of wrt")),
    (lambda: sys.modules.update({"wrt.renderer.distributed.installed": None}),
     (None, "distributed.installed")),
])
def test_a_worker_with_another_installation_is_refused(client: Any, change: Any, said: Refusal) -> None:
    version, first = wrt.__version__, next(iter(client.scheduler_info()["workers"]))

    def put_back() -> None:
        if sys.modules["wrt"] is None:
            sys.modules["wrt"] = sys.modules.pop("kept")
        sys.modules["wrt"].__version__ = version  # type: ignore[attr-defined]
        if sys.modules.get("wrt.renderer.distributed.installed", 0) is None:
            sys.modules["wrt.renderer.distributed.installed"] = sys.modules["wrt"].renderer.distributed.installed  # type: ignore[attr-defined]

    render(SCENE, executor=client, spp=1)
    client.run(change, workers=[first])
    try:
        with refused(*said):
            render(SCENE, executor=client)
    finally:
        client.run(put_back, workers=[first])


@contextmanager
def worker_of_other_code(client: Any, folder: Path) -> Iterator[str]:
    """Start a `dask worker` process whose wrt has one more line in io/obj.py; yield its address. At the end it is gone."""
    for name in ("wrt", "kernels"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    with open(folder / "wrt" / "io" / "obj.py", "a", encoding="utf-8") as file:
        file.write("TILE_SIZE = 31\n")

    def address(found: bool) -> str:
        for _ in range(600):
            workers = client.scheduler_info(n_workers=-1)["workers"]
            (here,) = [address for address, worker in workers.items() if worker["id"] == str(folder)] or [""]
            if bool(here) == found:
                return str(here)
            time.sleep(0.1)
        raise AssertionError(f"the worker in {folder} does not {'appear' if found else 'leave'}")

    command = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address, "--nthreads", "1", "--no-dashboard",
               "--no-nanny", "--name", str(folder), "--local-directory", str(folder)]
    with subprocess.Popen(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)},
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as worker:
        try:
            yield address(True)
        finally:
            worker.terminate()
    address(False)


def test_a_worker_whose_code_differs_in_a_line_is_refused_by_name(threads: Any, mesh: Path) -> None:
    with distributed.Client(threads, set_as_default=False) as one, worker_of_other_code(one, mesh.parent / "other") as address:
        said = f"worker {address} has different code of wrt {wrt.__version__} (io/obj.py); install the same everywhere"
        with pytest.raises(InputError, match=f"^{re.escape(said)}$"):
            render(SCENE, executor=one)
        done = run("render", mesh, "-o", "a.png", "--cluster", threads.scheduler_address)
        assert (done.code, done.errors, Path("a.png").exists()) == (2, [f"error: {said}"], False)


def test_a_worker_that_comes_later_is_compared_too(threads: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A render compares a new worker before it prepares the scene."""
    with distributed.Client(threads, set_as_default=False) as one, worker_of_other_code(one, tmp_path / "other"):
        monkeypatch.setattr(cluster, "check_workers", lambda client: None)  # the worker connects after the check
        with refused(what="(io/obj.py)"):
            render(SCENE, executor=one, spp=256, tile_size=16, pass_size=4)


def test_a_scene_that_is_lost_is_sent_again(threads: Any, whole: Film, monkeypatch: pytest.MonkeyPatch) -> None:
    """This happens when all workers that had the scene die."""
    monkeypatch.setattr(workers, "_ready", type(workers._ready)())
    sent: list[Any] = []
    with distributed.Client(threads, set_as_default=False) as one:
        scatter = one.scatter
        monkeypatch.setattr(one, "scatter", lambda *rest, **how: [sent.append(scatter(*rest, **how)[0]), sent[-1]][1:])

        def progress(progress: Any) -> None:
            if len(sent) == 1:
                one.cancel(sent, force=True)

        assert same(render(SCENE, executor=one, progress=progress, **HOW), whole)
    assert len(sent) == 2


def test_a_render_without_any_worker_ends(threads: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 0.3)
    with distributed.Client(threads, set_as_default=False) as one, refused(what="no worker is left"):
        render(SCENE, executor=one, spp=1 << 16, size=(200, 200), progress=lambda progress: threads.scale(0))


def test_a_scheduler_that_goes_away_leaves_a_checkpoint(threads: Any, tmp_path: Path, whole: Film) -> None:
    path = tmp_path / "a.checkpoint"

    def progress(progress: Any) -> None:
        if progress.done > 4 * 61 * 34:
            threads.close()

    with distributed.Client(threads, set_as_default=False, timeout=1) as one:
        lost = "(the connection to the Dask scheduler is lost|no worker is left)"
        with pytest.raises(InputError, match=rf"^tcp://[0-9.:]*: {lost}; {path} has the samples so far$"):
            render(SCENE, executor=one, checkpoint=path, progress=progress, **HOW)
    film = render(SCENE, checkpoint=path, resume=True, aov="depth")
    assert film.stats["resumed"]["samples"] >= 1 and same(film, whole)


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.fixture
def mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "box.obj"
    path.write_text(BOX_OBJ)
    return path


def test_commands(threads: Any, mesh: Path) -> None:
    address = threads.scheduler_address
    for name, where in (("here", ()), ("there", ("--cluster", address)), ("devices", ("--device", "cpu,cpu"))):
        done = run("render", mesh, "-o", f"{name}.exr", "--size", "64x36", "--spp", 4, "--json", "-q", *where)
        assert done.code == 0 and json.loads(done.out)["samples"] == 64 * 36 * 4, done.err
    here = read_channels("here.exr")
    for name in ("there", "devices"):
        other = read_channels(f"{name}.exr")
        assert here.keys() == other.keys() and all(np.array_equal(here[layer], other[layer]) for layer in here)
    page = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    block = page.split("```python\n")[1].split("```")[0]
    assert block.count("tcp://scheduler:8786") == 1
    names: dict[str, Any] = {"wrt": wrt, "scene": SCENE}
    exec(block.replace("tcp://scheduler:8786", address).replace("spp=4096", "spp=2"), names)
    names["Client"].current().close()
    done = run("render", mesh, "--cluster", address, "--device", "cpu,cpu")
    assert done.code == 2 and len(done.errors) == 1 and "a worker for each device" in done.err


def test_wrong_addresses(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.3)
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 0.3)
    with socket.socket() as closed, socket.socket() as deaf:
        closed.bind(("127.0.0.1", 0))
        deaf.bind(("127.0.0.1", 0))
        deaf.listen()
        addresses = [f"tcp://127.0.0.1:{one.getsockname()[1]}" for one in (closed, deaf)]
        for address in (*addresses, "nonsense", "tcp://", "", "ftp://127.0.0.1:1", "tcp://127.0.0.1:99999999"):
            done = run("render", mesh, "--cluster", address)
            assert done.code == 2 and len(done.errors) == 1 and "no Dask scheduler at" in done.err, (address, done)
    with distributed.LocalCluster(n_workers=0, protocol="tcp://", dashboard_address=":0", silence_logs=50) as empty:
        done = run("render", mesh, "--cluster", empty.scheduler_address)
        assert done.code == 2 and len(done.errors) == 1 and "no worker at tcp://" in done.err and "dask worker tcp://" in done.err
    assert not list(mesh.parent.glob("*.png"))


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """Return the certificate and the key that docs/cluster.md describes; both files give access to the cluster."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl, to make a certificate")
    page = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^openssl [^#]*", page, re.MULTILINE)
    done = subprocess.run(line.split(), cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return tmp_path / "wrt.pem", tmp_path / "wrt.key"


def test_tls(certificate: tuple[Path, Path], mesh: Path) -> None:
    """Dask's configuration, from the environment, turns TLS on; wrt needs no option for it."""
    file, key = map(str, certificate)
    page = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
    values = {"$PWD/wrt.pem": file, "$PWD/wrt.key": key, "true": True}
    config = {name.lower().replace("__", "."): values[value] for name, value in re.findall(r"DASK_(DISTRIBUTED__\w+)=(\S+)", page)}
    assert len(config) == 8 and config["distributed.comm.require_encryption"]
    with dask.config.set(config), distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, protocol="tls://", security=distributed.Security(), silence_logs=50,
            dashboard_address=":0") as guarded:
        address = guarded.scheduler_address
        assert address.startswith("tls://")
        small = ("--size", "32x18", "--spp", 2, "-q")
        assert run("render", mesh, "-o", "here.exr", *small).code == 0
        done = run("render", mesh, "-o", "there.exr", *small, "--cluster", address)
        assert done.code == 0, done.err
        here, there = read_channels("here.exr"), read_channels("there.exr")
        assert all(np.array_equal(here[layer], there[layer]) for layer in here)
        with dask.config.set(dict.fromkeys(name for name in config if "scheduler" not in name and "worker" not in name)):
            for wrong in (address, address.replace("tls://", "tcp://")):
                done = run("render", mesh, "-o", "a.exr", *small, "--cluster", wrong)
                assert done.code == 2 and len(done.errors) == 1 and f"no Dask scheduler at '{wrong}'" in done.err, done
    assert not Path("a.exr").exists()


def test_without_distributed(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = run("render", mesh, "--cluster", "tcp://127.0.0.1:1")
    assert done.code == 2 and len(done.errors) == 1 and "pip install 'wrt[cluster]'" in done.err
