"""Queries need Warp and NumPy alone; the message on any other missing package has the line that installs it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command_line import BOX_OBJ
from tests.data import ROOT
from tests.refused import refused
from wrt.core.packages import needed_by

ABSENT = ("scipy", "pydantic", "PIL", "OpenImageIO", "pygltflib", "rich", "click", "trimesh", "matplotlib", "viser", "distributed",
          "elftools")
WITHOUT = f"import sys; sys.modules.update(dict.fromkeys({ABSENT}))\n"
QUERIES = """
import numpy as np, wrt
accel = wrt.build(wrt.load_mesh("box.obj"))
o, d = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
hits = accel.closest_hit(o, d)
assert hits.prim_id[0] >= 0 and accel.any_hit(o, d)[0] and hits.point.shape == hits.normal.shape == (1, 3)
assert wrt.count_hits(accel, o, d, crossings=True)[0] == 2 and len(wrt.all_hits(accel, o, d).t) >= 2
assert not wrt.contains(accel, o)[0] and abs(wrt.winding_number(accel, o)[0]) < 1e-9 and not wrt.visible(accel, o, -o)[0]
wrt.ray_query(accel)
accel.refit(2.0 * accel.geometry.vertices)
accel.save("box.accel")
"""


def run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True, check=False)


def test_queries_need_warp_and_numpy_alone(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    done = run("-c", WITHOUT + QUERIES, folder=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_missing_package_is_reported_with_the_line_that_installs_it(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    code = WITHOUT + f"""
import wrt
film = wrt.render("box.obj", size=(8, 8), spp=1)
for call in (lambda: wrt.load_scene({str(ROOT / "scenes" / "spot.toml")!r}), lambda: wrt.Mesh.from_trimesh(7),
             lambda: film.save("a.exr"), lambda: wrt.load_mesh("box.obj").to_trimesh()):
    try:
        call()
        print("nothing")
    except wrt.InputError as error:
        print(error)
"""
    done = run("-W", "ignore", "-c", code, folder=tmp_path)
    assert done.stdout.splitlines() == [
        "a TOML scene needs pydantic; pip install pydantic", "a mesh of trimesh needs trimesh; pip install trimesh",
        "an EXR or HDR picture needs OpenImageIO; pip install openimageio",
        "a mesh of trimesh needs trimesh; pip install trimesh"], done.stderr


def test_the_command_line_says_so_too(tmp_path: Path) -> None:
    done = run("-c", WITHOUT + "import runpy; runpy.run_module('wrt', run_name='__main__')", folder=tmp_path)
    assert (done.returncode, done.stderr) == (2, "error: the command line needs click; pip install click\n")


def test_other_errors_of_an_import_stay_what_they_are() -> None:
    with refused(what="thing needs no_such", hint="pip install no_such"), needed_by("a thing"):
        import no_such.part  # type: ignore[import-not-found]  # noqa: F401
    with pytest.raises(ZeroDivisionError), needed_by("a thing"):
        _ = 1 / 0
