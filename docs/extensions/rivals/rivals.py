"""Two rivals that need a C++ compiler, as contestants of `bench queries`: Embree's packets of sixteen rays, and tinybvh.

Embree is the library in the package embreex. The folder with tinybvh's header is named by the environment variable TINYBVH."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from weakref import finalize

import numpy as np

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.lab.bench.contestants import Contestant, cut
from wrt.lab.bench.rays import RaySet

COMPILERS = "c++", "g++", "clang++"
FLAGS = "-std=c++17", "-O3", "-march=native", "-w", "-shared", "-fPIC", "-pthread"
# Constants of rtcore_scene.h, rtcore_geometry.h, rtcore_buffer.h and rtcore_common.h.
ROBUST_SCENE, TRIANGLES, INDICES, VERTICES, UINT3, FLOAT3 = 1 << 2, 0, 0, 1, 0x5003, 0x9003
SLACK = 16  # bytes that Embree may read behind the last vertex
pointer = ctypes.c_void_p


@cache
def compiled(folder: str) -> ctypes.CDLL:
    """Compile rivals.cpp, with tinybvh if `folder` has its header."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise InputError("these contestants need a C++ compiler", hint=f"install one of {', '.join(COMPILERS)}")
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "rivals.so"
        source = Path(__file__).with_suffix(".cpp")
        done = subprocess.run([compiler, *FLAGS, "-I", folder or name, str(source), "-o", str(out)], capture_output=True, text=True)
        if done.returncode:
            raise InputError(f"{compiler} fails: {done.stderr.strip()[:500]}")
        found = ctypes.CDLL(str(out))
    found.embree_packets.argtypes = [pointer, pointer, ctypes.c_bool, ctypes.c_bool, ctypes.c_int, *[pointer] * 6]
    found.embree_packets.restype = None
    if folder:
        found.make_tree.restype = found.make_rays.restype = pointer
        found.make_tree.argtypes = [pointer, ctypes.c_int, ctypes.c_int]
        found.make_rays.argtypes = [pointer, pointer, pointer, ctypes.c_int]
        found.free_tree.argtypes = found.free_rays.argtypes = [pointer]
        found.closest.argtypes, found.occluded.argtypes = [pointer] * 6, [pointer] * 3
    return found


def addresses(*arrays):
    return [array.ctypes.data for array in arrays]


class FromC(Contestant):
    """A contestant whose search returns t, u, v, prim_id, or flags of the occluded rays."""

    def closest(self, origins, directions, t_min=0.0, t_max=np.inf):
        far = np.broadcast_to(np.asarray(t_max, np.float32), len(origins))
        t, u, v, prim_id = self.search(RaySet("", origins, directions, far), 1)()
        return cut(t, prim_id, u, v, t_min, t_max)


@cache
def embree_library() -> ctypes.CDLL:
    with needed_by("Embree"):
        from embreex import rtcore_scene
    embree = ctypes.CDLL(rtcore_scene.__file__)  # also finds symbols of the libraries that it links to
    for name in ("rtcNewDevice", "rtcNewScene", "rtcNewGeometry"):
        getattr(embree, name).restype = pointer
    embree.rtcSetSharedGeometryBuffer.argtypes = [pointer, *[ctypes.c_int] * 3, pointer, *[ctypes.c_size_t] * 3]
    embree.rtcNewGeometry.argtypes = embree.rtcSetSceneFlags.argtypes = [pointer, ctypes.c_int]
    embree.rtcAttachGeometry.argtypes = [pointer, pointer]
    for name in ("rtcNewDevice", "rtcNewScene", "rtcCommitGeometry", "rtcCommitScene", "rtcReleaseGeometry", "rtcReleaseScene",
                 "rtcReleaseDevice"):
        getattr(embree, name).argtypes = [pointer]
    return embree


class EmbreePackets(FromC):
    """Embree's rtcIntersect16 and rtcOccluded16 on a robust scene. rays: whether to set the flag for coherent rays."""

    NAME, FAMILY, package = "embree16", "embree", "embreex"
    OPTIONS = {"rays": ("coherent", "incoherent")}

    def load(self, geometry):
        embree = embree_library()
        device = embree.rtcNewDevice(b"threads=1")
        scene = embree.rtcNewScene(device)
        embree.rtcSetSceneFlags(scene, ROBUST_SCENE)
        triangles = embree.rtcNewGeometry(device, TRIANGLES)
        vertices = np.concatenate([np.ascontiguousarray(geometry.vertices).reshape(-1), np.zeros(SLACK // 4, np.float32)])
        faces = geometry.faces.astype(np.uint32)
        self.buffers = vertices, faces  # Embree reads these arrays without a copy
        for kind, form, array, count in ((VERTICES, FLOAT3, vertices, len(geometry.vertices)), (INDICES, UINT3, faces, len(faces))):
            embree.rtcSetSharedGeometryBuffer(triangles, kind, 0, form, array.ctypes.data, 0, 12, count)
        embree.rtcCommitGeometry(triangles)
        embree.rtcAttachGeometry(scene, triangles)
        embree.rtcReleaseGeometry(triangles)
        embree.rtcCommitScene(scene)
        self.scene = scene
        finalize(self, lambda: (embree.rtcReleaseScene(scene), embree.rtcReleaseDevice(device)))

    def search(self, rays, threads):
        n, embree, trace = len(rays), embree_library(), compiled("").embree_packets
        function = ctypes.cast(embree.rtcOccluded16 if rays.any_hit else embree.rtcIntersect16, pointer)
        o, d = (np.ascontiguousarray(each, np.float32) for each in (rays.origins, rays.directions))
        reach = np.ascontiguousarray(rays.t_max, np.float32)

        def run():
            out = [reach.copy(), np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32)]
            trace(function, self.scene, self.options["rays"] == "coherent", rays.any_hit, n, *addresses(o, d, *out))
            return out

        return run

    def result(self, out):
        return out[0] == -np.inf


class TinyBvh(FromC):
    """A tree of tinybvh with spatial splits. width: children of a node."""

    NAME = FAMILY = "tinybvh"
    OPTIONS = {"width": (8, 4)}

    def missing(self):
        folder = os.environ.get("TINYBVH", "")
        if not (Path(folder) / "tiny_bvh.h").is_file() or not folder:
            return "TINYBVH names no folder with tiny_bvh.h"
        return "" if compiled(folder).has_tree(self.options["width"]) else "this processor lacks the instructions"

    def load(self, geometry):
        self.library = compiled(os.environ["TINYBVH"])
        corners = np.zeros((len(geometry.faces), 3, 4), np.float32)
        corners[..., :3] = geometry.vertices[geometry.faces]
        self.tree = self.library.make_tree(*addresses(corners), len(corners), self.options["width"])
        finalize(self, self.library.free_tree, self.tree)

    def search(self, rays, threads):
        n, library, tree = len(rays), self.library, self.tree
        arrays = [np.ascontiguousarray(each, np.float32) for each in (rays.origins, rays.directions, rays.t_max)]
        own = library.make_rays(*addresses(*arrays), n)

        def closest():
            out = [*np.empty((3, n), np.float32), np.empty(n, np.int32)]
            library.closest(tree, own, *addresses(*out))
            return out

        def any_hit():
            out = np.empty(n, np.bool_)
            library.occluded(tree, own, *addresses(out))
            return out

        search = any_hit if rays.any_hit else closest
        finalize(search, library.free_rays, own)
        return search
