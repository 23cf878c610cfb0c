"""The house rules that a reader relies on: who imports whom, and that everything is packaged."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.data import ROOT

KERNELS = sorted((ROOT / "kernels").glob("*.py"))
HOST = sorted((ROOT / "wrt").rglob("*.py"))
ALLOWED = {"warp", "functools", "pathlib", "re", "typing"}
USE_KERNELS = ("accel/", "device.py", "device_film.py", "device_scene.py", "driver.py", "profiler.py",
               "cache_sim.py", "rtcore.py", "bench/")


def imports(path: Path) -> set[str]:
    """Every module that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return found


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_kernels_never_import_the_host_side(path: Path) -> None:
    assert all(name in ALLOWED or name.startswith("wrt.kernels.") for name in imports(path))


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_kernels_have_no_postponed_annotations(path: Path) -> None:
    assert "__future__" not in imports(path)  # a factory's annotation that is a closure variable would not be found


@pytest.mark.parametrize("path", HOST, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_only_some_host_modules_import_kernels(path: Path) -> None:
    allowed = path.relative_to(ROOT / "wrt").as_posix().startswith(USE_KERNELS)
    assert allowed or not any(name.startswith("wrt.kernels") for name in imports(path))


@pytest.mark.parametrize("path", [p for p in HOST if p.name not in ("__main__.py", "cli.py")], ids=lambda p: p.name)
def test_nothing_imports_the_command_line(path: Path) -> None:
    assert "wrt.cli.main" not in imports(path)


def test_units_come_before_traversals_before_the_integrator() -> None:
    layers = [("structs",), ("ray_", "sampling", "camera"), ("counters", "lanes", "wide_nodes", "triangle_cell", "cell_ray"),
              ("textures", "surface", "materials", "traverse", "lights"),
              ("shadows", "whitted", "query", "packets", "trace_packets", "build_", "refit_", "cache_lru", "end_point_overlap",
               "peers"),
              ("render", "rasterize", "primary_rays", "unit_probes")]

    def layer(name: str) -> int:
        return next(i for i, starts in enumerate(layers) if name.startswith(starts))

    for path in KERNELS:
        for name in imports(path) - ALLOWED:
            assert layer(name.removeprefix("wrt.kernels.")) <= layer(path.stem), f"{path.name} imports {name}"


def test_the_package_list_matches_the_tree() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in HOST}
    assert set(listed) == folders | {"wrt.kernels"}
    assert not (ROOT / "kernels" / "__init__.py").exists()


def test_kernels_refuse_a_second_name() -> None:
    code = "import sys; sys.path.insert(0, '.'); import kernels.structs"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and "import wrt.kernels.structs" in result.stderr


def test_help_imports_nothing_heavy() -> None:
    heavy = ("warp", "numpy", "trimesh", "pydantic", "OpenImageIO")
    code = f"import sys, wrt.cli.main; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_public_names_exist() -> None:
    import wrt

    for name in wrt.__all__:
        assert getattr(wrt, name) is not None
        assert not any((Path(folder) / f"{name}.py").exists() for folder in wrt.__path__)  # its import would hide the name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = wrt.nothing
