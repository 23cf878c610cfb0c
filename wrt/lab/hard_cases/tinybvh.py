"""tinybvh's BVH4_CPU and BVH8_CPU with spatial splits: a C++ file of wrt, compiled together with the user's copy of tinybvh's header."""

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.core.errors import InputError
from wrt.core.types import ArrayLike
from wrt.lab.bench.rays import RaySet
from wrt.lab.hard_cases.contestants import Peer, cut

HEADER = "tiny_bvh.h"
COMPILERS = "c++", "g++", "clang++"
FLAGS = "-std=c++17", "-O3", "-march=native", "-w", "-shared", "-fPIC", "-pthread"
WIDTHS = 4, 8


@cache
def library(folder: Path) -> ctypes.CDLL:
    """Compile tinybvh.cpp with the header in `folder`. Raise InputError without header or compiler, or if the compiler fails."""
    if not (folder / HEADER).is_file():
        raise InputError(f"has no {HEADER}, tinybvh's header", path=folder)
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise InputError("tinybvh needs a C++ compiler", hint=f"install one of {', '.join(COMPILERS)}")
    source = Path(__file__).with_suffix(".cpp")
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "tinybvh.so"
        done = subprocess.run([compiler, *FLAGS, "-I", str(folder.resolve()), str(source), "-o", str(out)], capture_output=True, text=True)
        if done.returncode:
            raise InputError(f"{compiler} cannot compile {HEADER}: {done.stderr.strip()[:500]}", path=folder)
        found = ctypes.CDLL(str(out))
    pointer = ctypes.c_void_p
    found.make_tree.restype = found.make_rays.restype = pointer
    found.has_tree.restype = ctypes.c_bool
    found.make_tree.argtypes = [pointer, ctypes.c_int, ctypes.c_int]
    found.make_rays.argtypes = [pointer, pointer, pointer, ctypes.c_int]
    found.free_tree.argtypes = found.free_rays.argtypes = [pointer]
    found.closest.argtypes, found.occluded.argtypes = [pointer] * 6, [pointer] * 3
    return found


def version(folder: Path) -> str:
    """Return the version that the header states."""
    return ".".join(re.findall(r"^#define TINY_BVH_VERSION_\w+\s+(\d+)", (folder / HEADER).read_text("utf-8", "replace"), re.M)[:3])


def addresses(*arrays: np.ndarray) -> list[int]:
    return [array.ctypes.data for array in arrays]


class TinyBvh(Peer):
    """A tree of tinybvh with nodes of 4 or 8 children. folder: of the header. Raises InputError as `library` does."""

    family = "tinybvh"

    def __init__(self, folder: Path, width: int) -> None:
        self.name, self.width, self.library = f"tinybvh BVH{width}_CPU", width, library(folder)

    def load(self, geometry: Geometry) -> None:
        corners = np.zeros((len(geometry.faces), 3, 4), np.float32)
        corners[..., :3] = geometry.vertices[geometry.faces]
        self.tree = self.library.make_tree(*addresses(corners), len(corners), self.width)
        finalize(self, self.library.free_tree, self.tree)

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        far = np.broadcast_to(np.asarray(t_max, np.float32), len(origins))
        found: Any = self.search(RaySet("", origins, directions, far), 1)()
        t, u, v, prim_id = found
        return cut(t, prim_id, u, v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        n, tree = len(rays), self.tree
        arrays = [np.ascontiguousarray(each, np.float32) for each in (rays.origins, rays.directions, rays.t_max)]
        own = Handle(self, self.library.make_rays(*addresses(*arrays), n))

        def closest() -> list[np.ndarray]:
            out = [*np.empty((3, n), np.float32), np.empty(n, np.int32)]
            self.library.closest(tree, own.address, *addresses(*out))
            return out

        def any_hit() -> np.ndarray:
            out = np.empty(n, np.bool_)
            self.library.occluded(tree, own.address, *addresses(out))
            return out

        return any_hit if rays.any_hit else closest

    def occluded(self, out: np.ndarray) -> np.ndarray:
        return out


class Handle:
    """Rays in tinybvh's own format, freed with this object."""

    def __init__(self, peer: TinyBvh, address: int) -> None:
        self.address = address
        finalize(self, peer.library.free_rays, address)


def trees(folder: Path) -> Sequence[TinyBvh]:
    """Return the trees that this processor can trace."""
    return [TinyBvh(folder, width) for width in WIDTHS if library(folder).has_tree(width)]
