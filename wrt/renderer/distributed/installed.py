"""The parts of this installation that can change a bit of a result: the code of wrt, and the versions of Python, NumPy and Warp.

All machines that share work must have the same parts. Comparing wrt's version is not enough: two checkouts of it can differ in any line.
"""

import sys
from hashlib import sha256
from importlib import import_module
from pathlib import Path

import numpy as np
import warp as wp

from wrt.core.version import VERSION

CODE = (".py", ".h", ".cpp", ".cu")
SHOWN = 3  # largest number of files named in a message
SAME_EVERYWHERE = "install the same everywhere"  # hint of errors
Installed = dict[str, dict[str, str]]


def _files() -> dict[str, str]:
    """Return a digest of each source file of wrt and of kernels/, by the file's path in the package."""
    folders = [("", Path(__file__).parents[2]), *(("kernels/", Path(folder)) for folder in import_module("wrt.kernels").__path__)]
    digests = {before + path.relative_to(folder).as_posix(): sha256(path.read_bytes()).hexdigest()[:16]
               for before, folder in folders for path in folder.rglob("*") if path.suffix in CODE}
    return dict(sorted(digests.items()))


# Read once, at import, because a file that changes later is not the code that runs.
INSTALLED: Installed = {
    # A minor version of Python can change arithmetic, as 3.12 changed the sum() of floats.
    "versions": {"wrt": VERSION, "Python": "{}.{}".format(*sys.version_info), "NumPy": np.__version__,
                 "Warp": wp.__version__},
    "files": _files(),
}
DIGEST = sha256(repr(INSTALLED).encode()).hexdigest()


def difference(here: Installed, there: Installed) -> str:
    """Return as text how the installation `there` differs from `here`; "" if both are equal."""
    ours, theirs = here["versions"], there["versions"]
    differ = [f"{name} {theirs.get(name)} (here {version})" for name, version in ours.items() if theirs.get(name) != version]
    files = sorted(name for name in {**here["files"], **there["files"]} if here["files"].get(name) != there["files"].get(name))
    if files and ours["wrt"] == theirs.get("wrt"):  # another version has many other files
        more = f" and {len(files) - SHOWN} more" if len(files) > SHOWN else ""
        differ.append(f"different code of wrt {ours['wrt']} ({', '.join(files[:SHOWN])}{more})")
    return "; ".join(differ)
