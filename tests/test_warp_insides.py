"""Only three Python files name undocumented parts of Warp, one each of host code, device code and the virtual GPU; native code uses
few words of Warp's C++. So the work for the next version of Warp is known; docs/warp.md lists these files and words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.data import ROOT

SOURCES = sorted(path for folder in ("wrt", "kernels") for path in (ROOT / folder).rglob("*.py")
                 if not path.is_relative_to(ROOT / "wrt" / "kernels"))
FOR_INSIDES = {"wrt/core/warp_private.py", "kernels/warp_private.py"}
VIRTUAL_GPU = sorted((ROOT / "tests" / "virtual_gpu").rglob("*.py"))
# Attributes of Warp's objects without an underscore that Warp does not document.
UNDOCUMENTED = {"adj", "codegen", "ctype", "execs", "get_kernel_hooks", "get_module_hash", "get_module_identifier", "hash_module",
                "hashers", "hooks", "launch_bounds_t", "native_func", "params", "params_addr", "runtime", "array_t", "vars"}
# Names with an underscore that files may use although the project does not define them, and their owners.
OF_OTHERS = {"_digest": "a row of bench error",
             "_version": "torch.Tensor", "_replace": "NamedTuple", "_asdict": "NamedTuple", "_fields": "NamedTuple",
             "_exit": "os", "_getframe": "sys", "_run_exitfuncs": "atexit", "_obj": "ctypes.byref"}
CLICK = {"wrt/cli/common.py", "wrt/cli/reporting.py", "wrt/cli/measure.py"}  # files that use `params` of click's commands
TEXTS = re.compile(r"\b_?wp_|WP_[A-Z]|Warp CUDA|NVIDIA CUDA")
# Words of Warp's C++ that the native code of kernels/ may use.
NATIVE = {"wp::atomic_add", "wp::vec_t", "wp::float32", "wp::float64", "wp::uint64", "wp::launch_bounds_t"}


def made_here() -> frozenset[str]:
    """Return every name that a file of the project defines or assigns."""
    names = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
                names.add(node.id if isinstance(node, ast.Name) else node.attr)
    return frozenset(names)


OURS = made_here()


def insides(source: str, file: str = "") -> Iterator[str]:
    """Yield the undocumented names of Warp, and strings about them, in Python source."""
    tree = ast.parse(source)
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom | ast.Import):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names]
            names = [each.name for each in node.names]
            yield from (name for name in (*modules, *names) if name.startswith("warp._") or name in UNDOCUMENTED)
        elif isinstance(node, ast.Attribute):
            private = (re.match("_[^_]|__ctype__", node.attr) and node.attr not in OURS | OF_OTHERS.keys()
                       and ast.unparse(node.value) not in ("self", "cls", "super()"))
            if private or (node.attr in UNDOCUMENTED and not (node.attr == "params" and file in CLICK)):
                yield ast.unparse(node)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str | bytes) and id(node) not in prose:
            text = node.value if isinstance(node.value, str) else node.value.decode(errors="replace")
            if "\n" not in text and not file.startswith("kernels/"):  # native_words() looks at native code
                yield from TEXTS.findall(text)


@pytest.mark.parametrize("source", [
    "from warp._src import context", "import warp._src.types", "from warp.types import array_t", "x = wp._src",
    "command.hooks.forward", "size, *rest = command.params", "struct._cls", "f(data).vars.items()", "record.__ctype__()",
    "kernel.module.get_module_hash(1)", "kernel.adj", "getattr(kind, '_wp_scalar_type_', kind)", "folder.glob('wp_*')",
    "text in b'Warp CUDA error'",
    "module._get_meta_name()", "struct.ctype", "wp.context.runtime.tape"])
def test_the_search_finds(source: str) -> None:
    assert list(insides(source))


@pytest.mark.parametrize("path", [path for path in SOURCES if path.relative_to(ROOT).as_posix() not in FOR_INSIDES],
                         ids=lambda path: path.relative_to(ROOT).as_posix())
def test_insides_of_warp_are_named_in_their_files_only(path: Path) -> None:
    assert list(insides(path.read_text(), path.relative_to(ROOT).as_posix())) == []


@pytest.mark.parametrize("path", [path for path in VIRTUAL_GPU if path.name != "warp_private.py" and "test_" not in path.name],
                         ids=lambda path: path.name)
def test_the_virtual_gpu_imports_no_private_module_elsewhere(path: Path) -> None:
    """Strings such as "wp_..." are allowed: the virtual GPU implements Warp's C functions."""
    assert [each for each in insides(path.read_text()) if each.startswith("warp.") or "." in each] == []


def native_words() -> set[str]:
    texts = [path.read_text() for path in (ROOT / "kernels").rglob("*") if path.suffix in (".py", ".h")]
    return {word for text in texts for word in re.findall(r"\bwp::\w+|\bWP_\w+", text)}


def test_native_code_uses_few_words_of_warps() -> None:
    assert native_words() <= NATIVE


def test_the_page_for_the_next_version_lists_every_word_and_file() -> None:
    page = (ROOT / "docs" / "warp.md").read_text()
    for each in (*native_words(), *FOR_INSIDES, "tests/virtual_gpu/warp_private.py", "kernels/launches.py"):
        assert f"`{each}`" in page or f"(../{each})" in page, each


def test_warp_1_17_compiles_all_indices() -> None:
    """Before the field of an array's element, Warp 1.17 reads no index that is itself a field or an element: a variable must hold it."""
    for path in SOURCES:
        if path.is_relative_to(ROOT / "kernels"):
            elements = [node.value for node in ast.walk(ast.parse(path.read_text()))
                        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Subscript)]
            found = [ast.unparse(each) for each in elements if isinstance(each.slice, ast.Attribute | ast.Subscript)]
            assert [text for text in found if not text.startswith("BACKGROUNDS[")] == [], path
