"""Rules of the architecture: allowed imports between folders, limits on size, and what `import wrt` provides."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.data import ROOT

KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
HOST = sorted(path for path in (ROOT / "wrt").rglob("*.py") if not path.is_relative_to(ROOT / "wrt" / "kernels"))
# For each folder of wrt/, the other folders that its modules may import. `kernels` is the folder kernels/, imported as wrt.kernels.
BELOW_WRT = {
    "core": set(),
    "scene": {"core"},
    "picture": {"core"},
    "io": {"scene", "picture", "core"},
    "sensors": {"accel", "scene", "core"},
    "accel": {"io", "kernels", "scene", "core"},
    "compat": {"accel", "kernels", "io", "scene", "core"},
    "renderer": {"accel", "kernels", "io", "scene", "picture", "core"},
    "viewer": {"renderer", "accel", "io", "scene", "picture", "core"},
    "lab": {"renderer", "accel", "kernels", "io", "scene", "picture", "core"},
    "cli": {"lab", "viewer", "renderer", "accel", "io", "scene", "picture", "core"},
}
# The layers of wrt/accel, lowest first: a module imports from its own layer and from lower layers. A module that is named nowhere is
# in the layer of "bvh". Queries are below the structures, because the methods of structures call them.
LAYERS_OF_ACCEL = (
    {"geometry", "device_geometry", "flat_scene"},  # geometry
    {"structures", "snapshot"},  # kinds of structures, and the state of a structure
    {"queries"},
    {"store", "base", "box_tree", "tensors"},
    {"bvh", "cells", "brute_force"},
    {"top_level", "moves", "instances"},
    {"scenes"},
)
MESHES = {"wrt.scene.mesh", "wrt.scene.clean", "wrt.scene.values"}  # the modules of wrt.scene that layers below "scenes" may import
# Names with an underscore that other modules may use, and why.
PRIVATE = {"_replace": "public, of a NamedTuple"}
SET_FROM_OUTSIDE = {"requires_grad": "of Warp's arrays", "path": "of an InputError with another message"}
# For each module directly in wrt/, the folders that it may import; imports under TYPE_CHECKING do not count.
IN_WRT = {
    "__init__": {"core"},
    "__main__": {"cli", "core"},
    "jax": {"accel", "core"},
    "testing": {"lab"},
    "torch": {"accel", "core"},
}
# For each folder of wrt/, the parts of kernels/ that it may import; folders that are not listed import none.
KERNELS_OF_HOST = {
    "accel": {"launches", "hit_lists", "query", "ray_query", "transforms", "winding", "build", "shade", "traverse", "wide",
              "units", "warp_private", "structs"},
    "compat": {"placed_rays", "query", "shape_rays"},
    "renderer": {"parameters", "launches", "query", "loops", "shade", "traverse", "wide", "warp_private", "structs"},
    "lab": {"query", "study", "shade", "traverse", "units", "warp_private", "structs"},
}
# The laboratory, wrt/lab and kernels/study: only files under these paths may name it.
LABORATORY = re.compile(r"\bwrt[./]lab\b|\bkernels[./]study\b")
NAME_THE_LABORATORY = ("wrt/lab/", "kernels/study/", "wrt/cli/", "wrt/testing.py", "wrt/__init__.py")
# For each module and folder of kernels/, the others that it may import.
BELOW_KERNELS = {
    "headers": set(),
    "launches": {"structs"},
    "parameters": set(),
    "structs": {"headers", "parameters"},
    "warp_private": set(),
    "rows": {"warp_private"},
    "units": {"structs"},
    "traverse": {"units", "structs"},
    "query": {"traverse", "units", "structs"},
    "transforms": set(),
    "hit_lists": {"query", "units", "structs"},
    "placed_rays": {"query", "structs"},
    "ray_query": {"query", "structs"},
    "shape_rays": {"structs"},
    "winding": {"traverse", "structs"},
    "wide": {"headers", "rows", "hit_lists", "query", "traverse", "units", "structs"},
    "shade": {"warp_private", "parameters", "rows", "query", "transforms", "traverse", "units", "structs"},
    "loops": {"shade", "headers", "parameters", "launches", "rows", "query", "traverse", "units", "structs"},
    "build": {"headers", "transforms", "wide", "traverse", "units", "structs"},
    "study": {"headers", "query", "shade", "wide", "build", "traverse", "units", "structs"},
}
LIBRARIES_OF_KERNELS = {"warp", "dataclasses", "functools", "re", "typing", "collections", "math", "pathlib"}
# Limits. Lower them after a change that allows it.
LONGEST_FUNCTION = 100  # Lines.
LONG_FUNCTIONS = 9  # Functions with more than 60 lines.
LONG_SIGNATURES = 7  # Functions with more than 7 parameters: public queries.
AS_ELSEWHERE = {"multi_ray": 10}  # Parameters of functions that have those of another library's function.
# Lines of each folder of wrt and kernels, with headers. A commit may lower an entry, or raise one and lower others by as much.
MOST_LINES = {
    "kernels": 1886, "kernels/build": 3457, "kernels/loops": 1761, "kernels/shade": 4291, "kernels/study": 655,
    "kernels/traverse": 2050, "kernels/units": 815, "kernels/wide": 3852, "wrt": 366, "wrt/accel": 8704,
    "wrt/cli": 1122, "wrt/compat": 1392, "wrt/core": 1895, "wrt/io": 3275, "wrt/lab": 7547, "wrt/picture": 1137,
    "wrt/renderer": 3450, "wrt/scene": 2482, "wrt/sensors": 966, "wrt/viewer": 1298,
}


def module(path: Path) -> str:
    name = path.relative_to(ROOT).with_suffix("").as_posix().removesuffix("/__init__").replace("/", ".")
    return f"wrt.{name}" if name.startswith("kernels") else name


FILES = {module(path): path for path in (*HOST, *KERNELS)}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> frozenset[str]:
    """Return every module that a file imports, also within functions and under TYPE_CHECKING."""
    return imported(tree(path))


def imported(code: ast.Module) -> frozenset[str]:
    found = set()
    for node in ast.walk(code):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            found |= {f"{base}.{alias.name}" if f"{base}.{alias.name}" in FILES else base for alias in node.names}
    return frozenset(found)


def run_time(path: Path) -> ast.Module:
    """Return the syntax tree of a file without its blocks `if TYPE_CHECKING`."""
    body = [node for node in tree(path).body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    return ast.Module(body, [])


def strings(path: Path) -> Iterator[str]:
    """Yield the string literals of a file, without docstrings."""
    documented = (node for node in ast.walk(tree(path)) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef))
    docstrings = {id(node.body[0].value) for node in documented if node.body and isinstance(node.body[0], ast.Expr)}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def ids(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def each(paths: list[Path]) -> Callable[[Callable[[Path], None]], Callable[[], None]]:
    """Turn a check of one path into one test over all paths, which names the path that fails: 2,000 separate tests take 10 s."""

    def decorate(check: Callable[[Path], None]) -> Callable[[], None]:
        def over_all() -> None:
            for path in paths:
                try:
                    check(path)
                except Exception as error:
                    raise AssertionError(f"{ids(path)}: {error}") from error

        over_all.__doc__ = check.__doc__
        return over_all

    return decorate


def folder(name: str, below: str) -> str:
    """Return the name after the prefix `below`: "accel" for wrt.accel.bvh.builders below wrt."""
    rest = name.removeprefix(below).strip(".")
    return rest.split(".")[0]


@each([path for path in HOST if path.parent != ROOT / "wrt"])
def test_host_folders_import_downward_only(path: Path) -> None:
    here = folder(module(path), "wrt")
    there = {folder(name, "wrt") for name in imports(path) if name == "wrt" or name.startswith("wrt.")}
    assert there - {here, ""} <= BELOW_WRT[here]


def layer(name: str) -> int:
    """Return the index of a module of wrt.accel in LAYERS_OF_ACCEL."""
    places = {each: i for i, names in enumerate(LAYERS_OF_ACCEL) for each in names}
    return places.get(folder(name, "wrt.accel"), places["bvh"])


@each([path for path in HOST if path.is_relative_to(ROOT / "wrt" / "accel")])
def test_layers_of_accel_import_downward_only(path: Path) -> None:
    here = layer(module(path))
    assert max((layer(name) for name in imports(path) if name.startswith("wrt.accel.")), default=0) <= here
    if here < layer("wrt.accel.scenes"):
        assert {name for name in imports(path) if name.startswith(("wrt.scene", "wrt.io"))} <= MESHES


def test_a_query_imports_no_scene_and_no_reader() -> None:
    code = ("import sys, wrt.accel.structures as s; import wrt.accel.instances, wrt.accel.queries.visible\n"
            "all(s.ACCELERATORS.values()); print([m for m in sys.modules if m.startswith(('wrt.io', 'wrt.scene.model'))])")
    assert run(code, ROOT, ROOT) == "[]"


@each([p for p in HOST if folder(module(p), "wrt") in ("accel", "renderer", "compat")])
def test_private_names_are_used_where_they_are_made(path: Path) -> None:
    """`x._name`, where x is not self, is allowed only in the module that defines `_name`."""
    nodes = list(ast.walk(tree(path)))
    made = {node.name for node in nodes if isinstance(node, ast.FunctionDef)} | {
        node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
        and ast.unparse(node.value) == "self"}
    for node in nodes:
        if isinstance(node, ast.Attribute) and re.match("_[^_]", node.attr) and node.attr not in made | PRIVATE.keys():
            assert ast.unparse(node.value) in ("self", "cls", "super()"), f"line {node.lineno}: {ast.unparse(node)}"


@cache
def fields_of_records() -> frozenset[str]:
    """Return the names of the fields of all structs of device code."""
    classes = [node for path in KERNELS for node in ast.walk(tree(path)) if isinstance(node, ast.ClassDef)]
    return frozenset(ast.unparse(each.target) for node in classes for each in node.body if isinstance(each, ast.AnnAssign))


@each([p for p in HOST if folder(module(p), "wrt") in ("accel", "renderer", "compat")])
def test_objects_set_their_own_fields(path: Path) -> None:
    """`x.name = ...`, where x is not self, is allowed only for the fields of device code's structs, and for private names."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) not in ("self", "cls"):
            allowed = node.attr in fields_of_records() or node.attr.startswith("_") or node.attr in SET_FROM_OUTSIDE
            assert allowed, f"line {node.lineno}: {ast.unparse(node)}"


@each([path for path in HOST if path.parent == ROOT / "wrt"])
def test_modules_of_the_package_import_what_they_may(path: Path) -> None:
    there = {folder(name, "wrt") for name in imported(run_time(path)) if name.startswith("wrt.")}
    assert there <= IN_WRT[path.stem]


@each([path for path in HOST if path.parent != ROOT / "wrt"])
def test_host_folders_import_their_parts_of_kernels(path: Path) -> None:
    parts = {folder(name, "wrt.kernels") for name in imports(path) if name.startswith("wrt.kernels")}
    assert parts <= KERNELS_OF_HOST.get(folder(module(path), "wrt"), set())


@each([path for path in (*HOST, *KERNELS) if not ids(path).startswith(NAME_THE_LABORATORY)])
def test_the_product_does_not_name_the_laboratory(path: Path) -> None:
    assert [name for name in (*imports(path), *strings(path)) if LABORATORY.search(name)] == []


def test_the_product_does_without_the_laboratory(tmp_path: Path) -> None:
    for name, without in (("wrt", "lab"), ("kernels", "study")):
        shutil.copytree(ROOT / name, tmp_path / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", without))
    code = ("import wrt; from wrt.scene.shapes import icosphere; assert len([*wrt.ACCELERATORS.values()]) > 10; "
            "print(wrt.build(icosphere(1)).closest_hit([[0, 0, 3]], [[0, 0, -1]]).prim_id[0] >= 0)")
    assert run(code, tmp_path, tmp_path) == "True"
    render = [sys.executable, "-m", "wrt", "render", str(ROOT / "scenes" / "whitted.toml"), "--size", "8x8", "--spp", "1", "-q"]
    result = subprocess.run(render, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "whitted.png\n", "")


@each([path for path in KERNELS if path.name != "__init__.py"])
def test_kernels_import_downward_only_and_never_the_host_side(path: Path) -> None:
    here = folder(module(path), "wrt.kernels")
    own = {name for name in imports(path) if name.startswith("wrt.kernels.")}
    assert {folder(name, "wrt.kernels") for name in own} - {here} <= BELOW_KERNELS[here]
    assert {name.split(".")[0] for name in imports(path) - own} <= LIBRARIES_OF_KERNELS


def test_kernels_call_nothing_whose_bits_are_the_compilers() -> None:
    """Device code uses no function of the C library, and none of Warp's that calls one: wrt.kernels.shade.elementary replaces them."""
    theirs = {"acos", "asin", "atan", "atan2", "cbrt", "cos", "cosh", "curlnoise", "erf", "erfc", "erfcinv", "erfinv", "exp", "log",
              "log10", "log2", "noise", "pnoise", "poisson", "pow", "quat_from_axis_angle", "quat_rpy", "quat_slerp",
              "quat_to_axis_angle", "randn", "sample_triangle", "sample_unit_disk", "sample_unit_hemisphere",
              "sample_unit_hemisphere_surface", "sample_unit_ring", "sample_unit_sphere", "sample_unit_sphere_surface", "sin",
              "sinh", "tan", "tanh"}
    for path in KERNELS:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "wp":
                assert node.attr not in theirs, f"{path}: wp.{node.attr}"
            elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):  # Python evaluates a power of constants
                ast.literal_eval(ast.unparse(node.left)), ast.literal_eval(ast.unparse(node.right))
        assert "warp" not in {node.module for node in ast.walk(tree(path)) if isinstance(node, ast.ImportFrom)}
    for path in (ROOT / "kernels").rglob("*.h"):
        assert not re.search(rf"\b({'|'.join(sorted(theirs))})f?\(", path.read_text()), path


@each(KERNELS)
def test_kernels_have_no_postponed_annotations(path: Path) -> None:
    assert "__future__" not in imports(path)  # a factory's annotation that is a closure variable would not be found


def circles() -> Iterator[list[str]]:
    """Yield the groups of modules that import each other in a circle: strongly connected components (Tarjan 1972)."""
    edges = {name: sorted(imports(path) & FILES.keys() - {name}) for name, path in FILES.items()}
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> Iterator[list[str]]:
        number[name] = low[name] = len(number)
        stack.append(name)
        for other in edges[name]:
            if other not in number:
                yield from visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            group = stack[stack.index(name):]
            del stack[-len(group):]
            if len(group) > 1:
                yield group

    # wrt/__init__.py imports all public names under TYPE_CHECKING, which makes no circles at run time.
    edges["wrt"] = []
    for name in edges:
        if name not in number:
            yield from visit(name)


def test_nothing_imports_in_circles() -> None:
    assert list(circles()) == []


@each([p for p in HOST if p.name != "__main__.py" and p.parent.name != "cli"])
def test_nothing_imports_the_command_line(path: Path) -> None:
    assert not any(name.startswith("wrt.cli") for name in imports(path))


def test_the_package_shows_its_folders() -> None:
    top = sorted((ROOT / "wrt").iterdir())
    assert len([path for path in top if path.is_dir() and path.name != "__pycache__"]) <= 12
    assert len([path for path in top if path.suffix == ".py"]) <= 6
    for path in {path.parent for path in (*HOST, *KERNELS)}:
        assert ast.get_docstring(tree(path / "__init__.py")), f"{path} does not say what is in it"


@each([*HOST, *KERNELS])
def test_nothing_is_too_large_to_read(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ClassDef):
            assert (node.end_lineno or 0) - node.lineno < 200, f"class {node.name}"
        elif isinstance(node, ast.FunctionDef) and not any("kernel" in ast.unparse(each) for each in node.decorator_list):
            names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            assert len([each for each in names if each.arg not in ("self", "cls")]) <= AS_ELSEWHERE.get(node.name, 9), node.name


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Yield "file name" and syntax tree of every function, method, kernel and nested function."""
    for path in (*HOST, *KERNELS):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{ids(path)} {node.name}", node


def test_functions_are_short() -> None:
    """The lines of nested functions count as lines of the outer function."""
    lengths = [(name, (node.end_lineno or 0) - node.lineno + 1) for name, node in functions()]
    assert [name for name, length in lengths if length > LONGEST_FUNCTION] == []
    long = [name for name, length in lengths if length > 60]
    assert len(long) <= LONG_FUNCTIONS, long


def test_each_folder_keeps_to_its_lines() -> None:
    lines = Counter[str]()
    for path in (*HOST, *KERNELS, *(ROOT / "kernels").rglob("*.h")):
        lines["/".join(path.relative_to(ROOT).parts[:-1][:2])] += path.read_text("utf-8").count("\n")
    assert lines.keys() == MOST_LINES.keys()
    assert {folder: count for folder, count in lines.items() if count > MOST_LINES[folder]} == {}, MOST_LINES


def test_signatures_are_short() -> None:
    parameters = [(name, {each.arg for each in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)})
                  for name, node in functions() if [ast.unparse(each) for each in node.decorator_list] != ["overload"]]
    many = [name for name, names in parameters if len(names - {"self", "cls"}) > 7]
    assert len(many) <= LONG_SIGNATURES, many


def test_kernels_refuse_a_second_name() -> None:
    code = "import sys; sys.path.insert(0, '.'); import kernels.structs"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1 and "import wrt.kernels" in result.stderr


def copied(to: Path) -> None:
    """Copy the package without the symbolic link wrt/kernels: kernels/ is beside wrt/, as on systems without links."""
    for path in (*HOST, *KERNELS, *(ROOT / "kernels").rglob("*.h")):
        target = to / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())


def run(code: str, folder: Path, path: Path | str = "") -> str:
    environment = {**os.environ, "PYTHONPATH": str(path)}
    result = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_kernels_are_found_without_symbolic_links(tmp_path: Path) -> None:
    copied(tmp_path)
    code = "import wrt.kernels.structs as s, wrt; print(s.__name__, s.__file__, wrt.__path__)"
    assert run(code, tmp_path, tmp_path) == f"wrt.kernels.structs {tmp_path / 'kernels' / 'structs.py'} ['{tmp_path / 'wrt'}']"


def test_a_clone_called_wrt_does_not_hide_the_package(tmp_path: Path) -> None:
    copied(tmp_path / "wrt")
    site = tmp_path / "site"
    site.mkdir()
    (site / "wrt.pth").write_text(str(tmp_path / "wrt"))  # what an editable install writes
    start = f"import site; site.addsitedir({str(site)!r}); "
    assert run(start + "import wrt; print(wrt.__version__)", tmp_path) == "0.1.0"
    assert sysconfig.get_path("purelib")  # the folder to which pip would write wrt.pth


def test_help_imports_nothing_heavy() -> None:
    heavy = ("warp", "numpy", "trimesh", "OpenImageIO", "wrt.compat")
    code = ("import sys, wrt.cli.main; assert len(list(wrt.cli.main.cli.commands.values())) > 10; "
            f"print([m for m in {heavy} if m in sys.modules])")
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_public_names_exist() -> None:
    import wrt

    for name in wrt.__all__:
        assert getattr(wrt, name) is not None
        assert not any((Path(folder) / name).exists() or (Path(folder) / f"{name}.py").exists() for folder in wrt.__path__), (
            f"the import of a module wrt.{name} would hide the public name")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = wrt.nothing


def test_type_checkers_see_the_public_names() -> None:
    import wrt

    guarded = next(node for node in tree(ROOT / "wrt" / "__init__.py").body
                   if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.asname for node in guarded.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert {*seen, "__version__"} == set(dir(wrt)) >= set(wrt.__all__)
    assert all(name in (wrt.__doc__ or "") for name in seen)  # help(wrt) begins with them


@pytest.mark.parametrize("name", ["sensors.pinhole", "compat.open3d.RaycastingScene", "compat.trimesh.RayMeshIntersector",
                                  "compat.pyvista.RayTracer", "compat.mujoco.from_mujoco", "compat.newton.from_newton",
                                  "testing.hard_cases", "torch.closest_hit", "jax.closest_hit"])
def test_public_modules_are_found_without_an_import_of_their_own(name: str) -> None:
    code = f"import sys, wrt; assert not {{'numpy', 'warp'}} & set(sys.modules); print(wrt.{name}.__name__)"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == name.split(".")[-1]
