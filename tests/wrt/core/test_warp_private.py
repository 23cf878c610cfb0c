"""Private parts of Warp: another Warp is refused; the changes of its compiler act on wrt's modules alone and change no kernel; headers
are precompiled once, and functions hashed once."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.command_line import without_compiling
from tests.data import ROOT

from tests.kernel_tools import cpu_only, launch, zeros  # isort: skip
import warp as wp

from wrt.core import warp_private
from wrt.core.device import preloading, start
from wrt.core.errors import InputError
from wrt.core.warp_private import WORKS_WITH
from wrt.io.load import load_scene
from wrt.kernels.structs import kernel
from wrt.kernels.warp_private import fields_of
from wrt.renderer.options import Options
from wrt.renderer.plan import plan_of

pytestmark = cpu_only
DIFFER = f"Warp {wp.config.version} is not supported, its insides differ"


def ours(function: Callable, monkeypatch: pytest.MonkeyPatch) -> wp.Kernel:
    """The function as a kernel of wrt."""
    return kernel_of("wrt.kernels.pretended", function, monkeypatch)


def kernel_of(module: str, function: Callable, monkeypatch: pytest.MonkeyPatch) -> wp.Kernel:
    monkeypatch.setattr(function, "__module__", module)
    monkeypatch.setattr(function, "__qualname__", f"{function.__name__}_{module[:3]}")
    return kernel(function)


def compiled(name: str) -> Path:
    """The folder of a kernel's module in the cache."""
    return next(Path(wp.config.kernel_cache_dir).glob(f"wp_{name}_*"))


# --- another Warp -----------------------------------------------------------------------------------------------------


def test_the_versions_that_work_are_those_that_pip_installs() -> None:
    assert f'"{WORKS_WITH}",' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize(("owner", "name", "change"), [
    *((*replaced, change) for replaced in warp_private._REPLACED for change in ("gone", "other parameters")),
    ("runtime", "tape", "gone"), ("runtime", "_apic_capture", "gone")])
def test_a_warp_that_differs_is_refused(owner: str, name: str, change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error comes before any function is replaced."""
    parts = {"Module": SimpleNamespace(), "codegen": SimpleNamespace(), "build": SimpleNamespace(),
             "runtime": SimpleNamespace(tape=None, _apic_capture=None)}
    for (each, function), parameters in warp_private._REPLACED.items():
        made = {}
        exec(f"def {function}({', '.join(parameters)}): ...", made)
        setattr(parts[each], function, made[function])
    before = {each: dict(vars(part)) for each, part in parts.items()}
    context = SimpleNamespace(Module=parts["Module"], runtime=parts["runtime"])
    for attribute, part in (("codegen", parts["codegen"]), ("build", parts["build"]), ("context", context)):
        monkeypatch.setattr(warp_private, attribute, part)
    if change == "gone":
        delattr(parts[owner], name)
    else:
        setattr(parts[owner], name, lambda self, other: None)
    with pytest.raises(InputError) as refused:
        warp_private.prepare()
    assert str(refused.value) == f"{DIFFER} ({owner}.{name}); install '{WORKS_WITH}'"
    for each, part in parts.items():
        left = {key: value for key, value in vars(part).items() if key != name}
        assert left == {key: value for key, value in before[each].items() if key != name}


@pytest.mark.parametrize(("owner", "name", "message"), [
    ("types", "array_t", "cannot import name 'array_t'"),
    *(("context.Module", name, f"type object 'Module' has no attribute '{name}'") for name in ("resolve_options", "_get_live_kernels")),
    ("config", "DeterministicMode", "module 'warp.config' has no attribute 'DeterministicMode'")])
def test_a_warp_without_a_name_is_one_message_of_the_command_line(owner: str, name: str, message: str, tmp_path: Path) -> None:
    scene, picture = ROOT / "scenes" / "whitted.toml", tmp_path / "out.png"
    code = (f"import sys\nfrom warp import config\nfrom warp._src import context, types\ndel {owner}.{name}\n"
            f"sys.argv = ['wrt', 'render', {str(scene)!r}, '--spp', '1', '--size', '8x8', '-o', {str(picture)!r}]\n"
            "from wrt.cli.main import main\nmain()\n")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1) and not picture.exists()
    assert done.stderr.startswith(f"error: {DIFFER} ({message}")
    assert done.stderr.endswith(f"); install '{WORKS_WITH}'\n")


@pytest.mark.parametrize("parameters", ["self, func, depth", "self", None])
def test_a_hasher_of_another_form_stays_as_it_is(parameters: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    hasher = SimpleNamespace()
    if parameters:
        exec(f"def hash_function({parameters}): ...", vars(hasher))
    before = dict(vars(hasher))
    monkeypatch.setattr(warp_private, "context", SimpleNamespace(ModuleHasher=hasher))
    warp_private._share_hashes()
    assert vars(hasher) == before


# --- structs ----------------------------------------------------------------------------------------------------------


@wp.struct
class Pair:
    a: wp.vec3
    b: float


def test_fields_are_those_of_a_struct_in_their_order() -> None:
    for pair in (Pair, Pair()):
        assert list(fields_of(pair).items()) == [("a", wp.vec3), ("b", wp.float32)]


@pytest.mark.parametrize(("kind", "scalar", "shape"), [(wp.vec3, "f4", (3,)), (wp.mat44, "f4", (4, 4)), (wp.int64, "i8", ()),
                                                       (wp.float32, "f4", ()), (wp.bool, "?", ()), (wp.uint8, "u1", ())])
def test_a_row_has_numpys_type(kind: object, scalar: str, shape: tuple[int, ...]) -> None:
    assert warp_private.row_type(kind) == np.dtype((scalar, shape))


# --- the compiler -----------------------------------------------------------------------------------------------------


def add_pairs(pairs: wp.array(dtype=Pair), sums: wp.array(dtype=float)):
    i = wp.tid()
    sums[i] = wp.dot(pairs[i].a, pairs[i].a) + pairs[i].b


def test_a_kernel_of_ours_holds_what_is_called_alone(monkeypatch: pytest.MonkeyPatch):
    pairs = np.zeros(3, Pair.numpy_dtype())
    pairs["a"], pairs["b"] = [[1.0, 2.0, 3.0]], [1.0, 2.0, 3.0]
    for module in ("wrt.kernels.pretended", "elsewhere"):
        made, sums = kernel_of(module, add_pairs, monkeypatch), zeros(3)
        launch(made, 3, wp.array(pairs, dtype=Pair, device="cpu"), sums)
        assert sums.numpy().tolist() == [15.0, 16.0, 17.0]
        (compiled_object,) = compiled(add_pairs.__qualname__).glob("*.o")
        assert (b"adj_atomic_add" in compiled_object.read_bytes()) == (module == "elsewhere")


def add_halves(numbers: wp.array(dtype=wp.bfloat16), sums: wp.array(dtype=float)):
    i = wp.tid()
    sums[i] = float(numbers[i]) + 0.5


def test_a_kernel_of_bfloat16_has_headers_with_it(monkeypatch: pytest.MonkeyPatch):
    start("cpu")
    numbers, sums = wp.array([1.0, 2.0, -4.0], dtype=wp.bfloat16, device="cpu"), zeros(3)
    launch(ours(add_halves, monkeypatch), 3, numbers, sums)
    assert sums.numpy().tolist() == [1.5, 2.5, -3.5]


@pytest.mark.parametrize("scene", ["whitted", "textures"])
def test_shared_hashes_are_those_of_warp(scene: str, monkeypatch: pytest.MonkeyPatch):
    """A kernel's name in the cache contains its hash."""
    start("cpu")
    made = plan_of(load_scene(ROOT / "scenes" / f"{scene}.toml"), Options()).kernels
    shared = [kernel.module.hash_module() for kernel in made]
    hasher = warp_private.context.ModuleHasher
    monkeypatch.setattr(hasher, "hash_function", hasher.hash_function.__wrapped__)
    assert len(made) > 4 and [kernel.module.hash_module() for kernel in made] == shared


@pytest.mark.parametrize(("flags", "kept"), [
    (None, "-march=native"), ("-march=native", "-march=native"), ("-O1 -ffast-math -fno-march=native", ""),
    ("-ffast-math -target-cpu x86-64-v3 -O0", "-target-cpu x86-64-v3"),
    ("-march=native -DNDEBUG -DWRT_CHECK -mllvm -x -Rpass=loop-vectorize", "-march=native -DWRT_CHECK -Rpass=loop-vectorize")])
def test_of_the_users_flags_the_processor_stays(flags: str | None, kept: str) -> None:
    """The others are Warp's default, which is None in Warp 1.17 and 1.18."""
    assert warp_private._own_flags(flags) == (wp.config.cpu_compiler_flags or "-march=native").replace("-march=native", kept).strip()


MINE = """
import sys
import warp as wp

@wp.struct
class Pair:
    a: wp.vec3
    b: float

@wp.kernel
def add_pairs(pairs: wp.array(dtype=Pair), sums: wp.array(dtype=float)):
    i = wp.tid()
    sums[i] = wp.dot(pairs[i].a, pairs[i].a) + wp.sin(pairs[i].b)

@wp.kernel
def count(n: wp.array(dtype=int)):
    n[0] = n[0] + 1

wp.config.log_level = wp.LOG_WARNING
if "with wrt" in sys.argv:
    import numpy, wrt
    wrt.build(wrt.Mesh(numpy.eye(3), numpy.array([[0, 1, 2]])), "brute_force").closest_hit(numpy.zeros((1, 3)), numpy.ones((1, 3)))
n = wp.zeros(1, dtype=int, device="cpu")
wp.launch(count, dim=1, inputs=[n], device="cpu")
"""


def test_kernels_of_a_user_are_compiled_as_without_wrt(tmp_path: Path):
    files = []
    for argument in ("with wrt", "without"):
        (tmp_path / "mine.py").write_text(MINE)
        environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / argument), "PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, tmp_path / "mine.py", argument], check=True, env=environment)
        (folder,) = (tmp_path / argument).glob("*/wp___main__*")
        files.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert files[0] == files[1] and {name.rsplit(".", 1)[1] for name in files[0]} == {"cpp", "o", "meta"}


@kernel
def add_one(numbers: wp.array(dtype=float)):
    numbers[0] += 1.0


@kernel
def add_two(numbers: wp.array(dtype=float)):
    numbers[0] += 2.0


def test_preloaded_kernels_are_loaded_at_the_end_of_the_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A process that is forked after the block has no lock that a thread of its parent holds."""
    start("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    numbers = zeros(1)
    with pytest.raises(KeyError), preloading(add_one, add_two):
        launch(add_one, 1, numbers)
        raise KeyError
    assert list(compiled("add_two").glob("*.o"))
    shutil.rmtree(tmp_path)  # loaded kernels are not loaded again
    with preloading(add_one, add_two):
        launch(add_two, 1, numbers)
    assert numbers.numpy().tolist() == [3.0] and not tmp_path.exists()


PRELOADED = """
from wrt.accel.queries.raw_launches import preload_headers
preload_headers()
"""


def test_headers_are_made_beforehand_where_the_cache_is_empty(tmp_path: Path):
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", PRELOADED], cwd=ROOT, capture_output=True, text=True, env=environment)
        assert (done.returncode, done.stdout, without_compiling(done.stderr)) == (0, "", "")
        assert len(list(tmp_path.glob("*/precompiled-*/*.pch"))) == 1
