"""Embree's queries for packets of 16 rays, its fastest ones, called in the C library of the embreex package."""

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar
from weakref import finalize

import numpy as np

from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.core.packages import needed_by
from wrt.core.types import ArrayLike
from wrt.lab.bench.rays import RaySet
from wrt.lab.hard_cases.contestants import Peer, cut

# Constants of rtcore_scene.h, rtcore_geometry.h, rtcore_buffer.h and rtcore_common.h.
ROBUST_SCENE, TRIANGLES, INDICES, VERTICES, UINT3, FLOAT3 = 1 << 2, 0, 0, 1, 0x5003, 0x9003
SLACK = 16  # bytes that Embree may read behind the last vertex


@cache
def library() -> ctypes.CDLL:
    """Load Embree 4. Raise InputError without embreex."""
    with needed_by("Embree"):
        from embreex import rtcore_scene
    embree = ctypes.CDLL(rtcore_scene.__file__)  # also finds symbols of the libraries that it links to
    pointer = ctypes.c_void_p
    for name in ("rtcNewDevice", "rtcNewScene", "rtcNewGeometry"):
        getattr(embree, name).restype = pointer
    embree.rtcSetSharedGeometryBuffer.argtypes = [pointer, *[ctypes.c_int] * 3, pointer, *[ctypes.c_size_t] * 3]
    embree.rtcNewGeometry.argtypes = embree.rtcSetSceneFlags.argtypes = [pointer, ctypes.c_int]
    embree.rtcAttachGeometry.argtypes = [pointer, pointer]
    for name in ("rtcNewDevice", "rtcNewScene", "rtcCommitGeometry", "rtcCommitScene", "rtcReleaseGeometry", "rtcReleaseScene",
                 "rtcReleaseDevice"):
        getattr(embree, name).argtypes = [pointer]
    return embree


class EmbreePackets(Peer):
    """Embree's rtcIntersect16 and rtcOccluded16 on a robust scene, with the flag for coherent rays."""

    name = "Embree robust, 16 coherent"
    package = "embreex"
    family = "Embree robust"
    coherent: ClassVar[bool] = True

    def load(self, geometry: Geometry) -> None:
        embree = library()
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

    def closest(self, origins: np.ndarray, directions: np.ndarray, t_min: ArrayLike = 0.0, t_max: ArrayLike = np.inf) -> Hits:
        found: Any = self.search(RaySet("", origins, directions, np.ones(len(origins))), 1)()
        t, u, v, prim_id = (getattr(found, name).numpy() for name in ("t", "u", "v", "prim_id"))
        return cut(t, prim_id, u, v, t_min, t_max)

    def search(self, rays: RaySet, threads: int) -> Callable[[], object]:
        import warp as wp

        from wrt.core.device import load_kernel
        from wrt.kernels.query import HitArrays
        from wrt.kernels.study.embree_packets import embree_packets

        load_kernel(embree_packets, wp.get_device("cpu"))
        n, function = len(rays), library().rtcOccluded16 if rays.any_hit else library().rtcIntersect16
        o, d = (wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.vec3, device="cpu") for a in (rays.origins, rays.directions))
        reach = wp.array(rays.t_max if rays.any_hit else np.full(n, np.inf), dtype=wp.float32, device="cpu")
        address = wp.uint64(ctypes.cast(function, ctypes.c_void_p).value or 0)

        def run() -> object:
            hits = HitArrays()
            hits.t = wp.clone(reach)
            if not rays.any_hit:
                hits.u, hits.v = (wp.empty(n, dtype=wp.float32, device="cpu") for _ in range(2))
                hits.prim_id = wp.empty(n, dtype=wp.int32, device="cpu")
            wp.launch(embree_packets, 1, [address, wp.uint64(self.scene), self.coherent, rays.any_hit, o, d, hits], device="cpu")
            return hits.t if rays.any_hit else hits

        return run

    def occluded(self, out: Any) -> np.ndarray:
        return np.asarray(out.numpy() == -np.inf)


class EmbreeIncoherentPackets(EmbreePackets):
    """EmbreePackets without the flag for coherent rays."""

    name = "Embree robust, 16 incoherent"
    coherent = False
