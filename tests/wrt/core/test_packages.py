"""Queries need Warp and NumPy alone; the message on any other missing package has the line that installs it."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.command_line import BOX_OBJ
from tests.data import ROOT
from tests.refused import refused
from wrt.core.packages import EXTRAS, INSTALLED_AS, needed_by

# An environment with Warp and NumPy alone: all other packages are hidden from imports.
LEAN = """
import sys

class Lean:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in {"wrt", "warp", "numpy", *sys.stdlib_module_names}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Lean())
"""
QUERIES = """
import numpy as np, wrt
mesh = wrt.load_mesh("box.obj")
accel = wrt.build(wrt.Mesh(mesh.vertices, mesh.faces))
o, d = np.array([[0.1, 0.2, -3.0]]), np.array([[0.0, 0.0, 1.0]])
hits = accel.closest_hit(o, d)
assert hits.prim_id[0] >= 0 and accel.any_hit(o, d)[0] and hits.point.shape == hits.normal.shape == (1, 3)
assert wrt.count_hits(accel, o, d, crossings=True)[0] == 2 and len(wrt.all_hits(accel, o, d).t) >= 2
assert not wrt.contains(accel, o)[0] and abs(wrt.winding_number(accel, o)[0]) < 1e-9 and not wrt.visible(accel, o, -o)[0]
assert abs(wrt.closest_points(accel, o).distance[0] - 2.0) < 1e-5
wrt.ray_query(accel)
accel.save("box.accel")
assert wrt.load_accel("box.accel", mesh).closest_hit(o, d).t.tolist() == hits.t.tolist() == [2.0]
accel.refit(2.0 * accel.geometry.vertices)
assert accel.closest_hit(o, d).t.tolist() == [1.0]
wrt.render("box.obj", size=(8, 8), spp=1).save("box.png")
assert not {"scipy", "PIL", "click"} & set(sys.modules)
"""
# Calls that need more, and the messages.
REFUSED = {
    "wrt.Mesh.from_trimesh(7)": "a mesh of trimesh needs trimesh; pip install trimesh",
    "wrt.load_mesh('box.obj').to_trimesh()": "a mesh of trimesh needs trimesh; pip install trimesh",
    "wrt.compat.trimesh": "wrt.compat.trimesh needs trimesh; pip install trimesh",
    "film.save('a.exr')": "an EXR or HDR picture needs OpenImageIO; pip install openimageio",
    "film.save('a.jpg')": "a.jpg: a JPEG or WebP picture needs PIL; pip install pillow",
    "wrt.load_mesh('bent.obj')": "bent.obj: a concave polygon needs mapbox_earcut; pip install mapbox-earcut",
    "wrt.Motion(keys=np.ones((2, 3, 3))).transform(0.5)": "a motion needs scipy; pip install scipy",
    "wrt.inspect('box.obj', (4, 4), size=(8, 8), spp=1).figure()": 'drawing rays needs matplotlib; pip install "wrt[plots]"',
}
# Imported packages that no requirement names: IPython is there in a notebook; open3d is
# compared with if the user installed it.
COME_WITH_OTHERS = {"IPython", "open3d"}
BENT_OBJ = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 1 0.5 0\nv 0 2 0\nf 1 2 3 4 5\n"


def run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True, check=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "box.obj").write_text(BOX_OBJ)
    (tmp_path / "bent.obj").write_text(BENT_OBJ)
    return tmp_path


def test_queries_need_warp_and_numpy_alone(folder: Path) -> None:
    done = run("-W", "ignore", "-c", LEAN + QUERIES, folder=folder)
    assert done.returncode == 0, done.stderr


def test_a_missing_package_is_reported_with_the_line_that_installs_it(folder: Path) -> None:
    code = LEAN + f"""
import numpy as np, wrt
film = wrt.render("box.obj", size=(8, 8), spp=1)
for call in {list(REFUSED)}:
    try:
        print("nothing from", call, eval(call))
    except wrt.InputError as error:
        print(error)
"""
    done = run("-W", "ignore", "-c", code, folder=folder)
    assert done.stdout.splitlines() == list(REFUSED.values()), done.stderr


def test_the_command_line_says_so_too(folder: Path) -> None:
    done = run("-c", LEAN + "import runpy; runpy.run_module('wrt', run_name='__main__')", folder=folder)
    assert (done.returncode, done.stderr) == (2, "error: the command line needs click; pip install click\n")
    without = "import sys; sys.modules['warp'] = None\nimport wrt.__main__ as script; sys.argv[1:] = sys.argv[2:]; script.main()"
    done = run("-c", without, "-", "devices", folder=folder)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (2, "error: this command needs warp; pip install warp")


def test_other_errors_of_an_import_stay_what_they_are() -> None:
    with refused(what="thing needs no_such", hint="pip install no_such"), needed_by("a thing"):
        import no_such.part  # type: ignore[import-not-found]  # noqa: F401
    with pytest.raises(ZeroDivisionError), needed_by("a thing"):
        _ = 1 / 0
    with pytest.raises(ModuleNotFoundError, match=r"wrt\.no_such"), needed_by("a thing"):
        import wrt.no_such  # type: ignore[import-not-found]  # noqa: F401


def imported() -> set[str]:
    """Return the packages that modules of wrt import at run time, anywhere in a file."""
    found = set()
    for path in (ROOT / "wrt").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        guarded = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
        skipped = {id(each) for block in guarded for each in ast.walk(block)}
        for node in ast.walk(tree):
            if id(node) not in skipped and isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif id(node) not in skipped and isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").split(".")[0])
    return found - sys.stdlib_module_names - {"wrt", "warp", "numpy"}


def test_every_imported_package_is_a_dependency_or_in_the_extra_that_its_message_names() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {extra: {re.split(r"[<>=\[]", line)[0] for line in lines} for extra, lines in project["optional-dependencies"].items()}
    default = {re.split(r"[<>=]", line)[0] for line in project["dependencies"]}
    packages = {module: INSTALLED_AS.get(module, module) for module in imported() | EXTRAS.keys()}
    packages = {module: package for module, package in packages.items() if module not in COME_WITH_OTHERS}
    astray = [module for module, package in packages.items()
              if package not in (named[EXTRAS[module]] if module in EXTRAS else default)]
    assert astray == []
