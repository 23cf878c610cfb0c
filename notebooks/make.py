"""Make the notebooks from their scripts: `python notebooks/make.py [NAME ...]` runs each .py and writes its .ipynb with outputs.

Edit only the .py (jupytext, percent format); the .ipynb has the same cells and their outputs. It contains no times of the run and
no names of the machine, so that a diff shows only changed cells and outputs.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent
METADATA = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"}}
QUICK = "WRT_QUICK"  # environment variable for smaller pictures and fewer rays
TIMEOUT = 600  # seconds per cell


def scripts() -> list[Path]:
    """Return the paths of the scripts of all notebooks."""
    return sorted(path for path in FOLDER.glob("*.py") if path.name != Path(__file__).name)


def read(script: Path) -> Any:
    """Return the notebook of a script, without outputs."""
    notebook = jupytext.read(script, fmt="py:percent")
    notebook.metadata = nbformat.from_dict(METADATA)
    for i, cell in enumerate(notebook.cells):
        cell.id = f"{i:02}-{hashlib.sha256(cell.source.encode()).hexdigest()[:8]}"
        cell.metadata = nbformat.from_dict({})
    return notebook


def execute(notebook: Any, quick: bool) -> Any:
    """Run all cells in a fresh kernel and return the notebook; raise CellExecutionError if a cell fails."""
    environment = {name: value for name, value in os.environ.items() if name != QUICK}
    path = os.pathsep.join(filter(None, [str(FOLDER.parent), environment.get("PYTHONPATH")]))  # imports wrt from this checkout
    environment |= {"PYTHONPATH": path, **({QUICK: "1"} if quick else {})}
    client = NotebookClient(notebook, timeout=TIMEOUT, kernel_name="python3", record_timing=False,
                            resources={"metadata": {"path": str(FOLDER)}})
    client.execute(env=environment)
    notebook.metadata = nbformat.from_dict(METADATA)  # drops the version of Python that ran it
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = merged(cell.outputs)
        for output in cell.get("outputs", []):
            if {"image/png", "image/jpeg"} <= output.get("data", {}).keys():
                del output["data"]["image/jpeg"]  # a copy of the PNG picture
    return notebook


def merged(outputs: list[Any]) -> list[Any]:
    """Join successive outputs of one text stream; the kernel splits them at arbitrary times."""
    out: list[Any] = []
    for output in outputs:
        if out and output.output_type == out[-1].output_type == "stream" and output.name == out[-1].name:
            out[-1].text += output.text
        else:
            out.append(output)
    return out


def main(names: list[str]) -> None:
    for script in scripts():
        if names and script.stem not in names:
            continue
        begin = time.perf_counter()
        target = script.with_suffix(".ipynb")
        nbformat.write(execute(read(script), quick=False), target)
        print(f"{target.name}: {time.perf_counter() - begin:.0f} s, {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
