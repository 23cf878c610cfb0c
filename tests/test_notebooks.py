"""The notebooks run, have the cells of their scripts (.py), and show no paths of the machine that ran them."""

from __future__ import annotations

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import without_compiling
from tests.data import ROOT

nbformat = pytest.importorskip("nbformat")
for needed in ("jupytext", "nbclient", "ipykernel", "matplotlib"):
    pytest.importorskip(needed, reason="needs the extras notebooks and dev")

SCRIPTS = [path for path in sorted((ROOT / "notebooks").glob("*.py")) if path.name != "make.py"]
LARGEST = 1_000_000  # bytes of a notebook
# Absolute paths of files, but neither "scenes/lens.toml" nor "a / b".
ABSOLUTE = re.compile(r"(?<![\w.)])(/(home|root|tmp|usr|opt|work|var|Users|private|mnt)/|[A-Z]:\\)")


def load_make() -> Any:
    spec = importlib.util.spec_from_file_location("make", ROOT / "notebooks" / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MAKE = load_make()


def texts(notebook: Any) -> list[str]:
    """Return the texts of all outputs but pictures."""
    found = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            assert output.output_type != "error", output
            if output.get("name") == "stderr":
                assert not without_compiling(output["text"])
                continue
            found += [output.get("text", "")]
            found += [str(data) for kind, data in output.get("data", {}).items() if not kind.startswith("image/")]
    return found


def check_outputs(notebook: Any) -> None:
    assert not [text for text in texts(notebook) if ABSOLUTE.search(text)]
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})]
    assert len(pictures) >= 3 and not any("image/jpeg" in output.data for output in pictures)


@pytest.mark.parametrize("scripts", [SCRIPTS[::2], SCRIPTS[1::2]], ids=["even", "odd"])
def test_notebooks_run(scripts: list[Path]) -> None:
    """Several notebooks share a Jupyter kernel, which takes seconds to start; each begins without the names of the one before."""
    notebooks = [MAKE.read(script) for script in scripts]
    together = nbformat.v4.new_notebook(cells=[
        cell for notebook in notebooks for cell in (nbformat.v4.new_code_cell("%reset -f"), *notebook.cells)])
    MAKE.execute(together, quick=True)
    for notebook in notebooks:
        check_outputs(notebook)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_notebook_has_the_cells_of_its_script_and_outputs(script: Path) -> None:
    path = script.with_suffix(".ipynb")
    notebook, source = nbformat.read(path, 4), MAKE.read(script)
    nbformat.validate(notebook)
    assert [(cell.id, cell.cell_type, cell.source) for cell in notebook.cells] == [
        (cell.id, cell.cell_type, cell.source) for cell in source.cells], f"python notebooks/make.py {script.stem}"
    assert notebook.metadata == MAKE.METADATA and all(not cell.metadata for cell in notebook.cells)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))  # from the top, in a fresh kernel
    assert path.stat().st_size < LARGEST
    check_outputs(notebook)


def test_every_notebook_has_a_script_and_a_line_in_the_index() -> None:
    notebooks = sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))
    assert notebooks == [path.stem for path in SCRIPTS] and notebooks
    index = (ROOT / "docs" / "README.md").read_text()
    assert all(f"(../notebooks/{name}.ipynb)" in index for name in notebooks)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_notebook_uses_the_public_interface(script: Path) -> None:
    source = script.read_text()
    assert not re.search(r"wrt\.kernels|import _|\._[a-z]", source) and "WRT_QUICK" in source


def test_the_folded_solution_of_claims_is_an_idea_for_hardware() -> None:
    """The program in the notebook's exercise runs, makes the same tests, and moves no bytes more."""
    import numpy as np

    import wrt
    from wrt.scene.shapes import icosphere

    (solution,) = re.findall(r"# ```python\n(.*?)# ```", (ROOT / "notebooks" / "claims.py").read_text(), re.DOTALL)
    ideas: list[Any] = []
    exec(re.sub(r"^# ?", "", solution, flags=re.MULTILINE), {"np": np, "replace": replace, "compare": ideas.append})
    (idea,) = ideas
    directions = np.random.default_rng(0).normal(size=(1024, 3))
    trace = wrt.trace(wrt.build(icosphere(5), "bvh2"), 2.0 * directions, -directions)
    before, after = trace.model().clocks, idea(trace).model().clocks
    assert after["box"] == before["box"] and after["triangle"] == before["triangle"] and after["DRAM"] < 0.95 * before["DRAM"]
    assert len(np.unique(idea(trace).address)) == len(np.unique(trace.address))


def test_absolute_paths_are_found() -> None:
    for text in (f"a file {Path('/home/me/x.png')}", '"/tmp/abc"', "C:\\Users\\me"):
        assert ABSOLUTE.search(text)
    for text in ("../scenes/lens.toml", "f / 2.25", "nodes/tmp/x", "</tr>", "0.25 [0.2, 0.3] 1/2"):
        assert not ABSOLUTE.search(text)


def test_the_jupyter_kernel_imports_this_checkout() -> None:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(
        "import os, wrt\nprint(wrt.__file__)\nprint('WRT_QUICK' in os.environ)")])
    output = MAKE.execute(notebook, quick=False).cells[0].outputs[0].text.splitlines()
    assert output == [str(ROOT / "wrt" / "__init__.py"), "False"] and sys.version_info >= (3, 11)
