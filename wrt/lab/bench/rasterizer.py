"""Primary visibility by two methods that share no code: a z-buffer and ray casting.

Both return depth (H, W) float32, the distance along the ray through the pixel's centre (inf on a miss), and prim_id (H, W) int32 (-1 on a
miss)."""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wrt.accel.geometry import Geometry
from wrt.accel.scenes.build import build
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import load_kernel, start, upload
from wrt.core.errors import InputError
from wrt.core.threads import run_all, thread_count
from wrt.kernels.study import rasterize as kernels
from wrt.renderer.pixel_rays import camera_rays
from wrt.renderer.upload import camera_struct
from wrt.scene.cameras import Camera, CameraKind

NOTHING = np.uint64(0x7F800000_FFFFFFFF)  # key of a pixel without a triangle: depth inf, prim_id -1
TRIANGLES_PER_LAUNCH = 65536
BANDS_PER_THREAD = 4  # several bands a thread, because bands differ in their numbers of triangles
ROWS_ON_CUDA = 16  # rows of a band; a CUDA thread draws the part of one triangle in one band


def as_perspective(camera: CameraKind) -> Camera:
    """Return the camera. Raise InputError for a camera under which straight edges may appear curved."""
    if not isinstance(camera, Camera):
        raise InputError(f"is {camera.kind}; the rasterizer needs a perspective camera", place=f"camera {camera.name!r}")
    return camera


def directions_from_pixels(camera: CameraKind, size: tuple[int, int]) -> np.ndarray:
    """Return the (3, 3) float64 matrix that maps (x, y, 1), in pixels from the top left corner, to the ray's direction, not normalised.
    The matrix has the render kernels' float32 camera. These kernels round the direction; the matrix gives it unrounded."""
    c = camera_struct(as_perspective(camera), size)
    right, up, forward = (np.array(list(v), np.float64) for v in (c.right, c.up, c.forward))
    tan_x, tan_y = (float(np.float32(value)) for value in (c.tan_x, c.tan_y))  # the struct still holds float64
    across, down = 2.0 * tan_x / size[0] * right, -2.0 * tan_y / size[1] * up
    return np.column_stack([across, down, forward - tan_x * right + tan_y * up])


def view_struct(camera: CameraKind, size: tuple[int, int], shift: tuple[float, float] = (0.0, 0.0)) -> kernels.View:
    """Return the View of a camera. shift: offset of the samples from the pixel centres, in pixels to the right and down."""
    from_pixels = directions_from_pixels(camera, size) @ np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], [0.0, 0.0, 1.0]])
    view = kernels.View()
    view.origin = wp.vec3d(*list(camera_struct(camera, size).origin))
    view.from_pixels, view.to_pixels = wp.mat33d(from_pixels), wp.mat33d(np.linalg.inv(from_pixels))
    view.width, view.height = size
    return view


class Rasterizer:
    """A z-buffer over a geometry's triangles: call `draw`, then `depth` and `prim_id`. It builds no acceleration structure."""

    def __init__(self, geometry: Geometry, device: str = "cpu", threads: int | None = None) -> None:
        if len(geometry.spheres):
            raise InputError(f"has {len(geometry.spheres)} spheres; a rasterizer draws only triangles", argument="geometry")
        self.device, self.threads = start(device), thread_count(threads)
        self.triangles = len(geometry.faces)
        self.vertices = upload(geometry.vertices, wp.vec3, self.device)
        self.faces = upload(geometry.faces, wp.vec3i, self.device)
        self.projected = wp.empty(len(geometry.vertices), dtype=wp.vec3d, device=self.device)
        self.boxes = wp.empty(self.triangles, dtype=wp.vec4i, device=self.device)
        self.all = wp.array(np.arange(self.triangles, dtype=np.int32), dtype=wp.int32, device=self.device)
        self.keys: Any = None
        self.size = (0, 0)
        for kernel in (kernels.project, kernels.bound, kernels.rasterize):
            load_kernel(kernel, self.device)

    def draw(self, camera: CameraKind, size: tuple[int, int], shift: tuple[float, float] = (0.0, 0.0)) -> None:
        """Draw all triangles, seen from the centre of the lens. shift: offset of the samples from the pixel centres, in pixels."""
        width, height = size
        view = view_struct(camera, size, shift)
        if self.size != size:
            self.keys, self.size = wp.empty(width * height, dtype=wp.uint64, device=self.device), size
        self.keys.fill_(NOTHING)
        if not self.triangles:
            return
        self._each_part(kernels.project, len(self.vertices), lambda first: [view, self.vertices, first, self.projected])
        self._each_part(kernels.bound, self.triangles, lambda first: [view, self.vertices, self.projected, self.faces, first, self.boxes])
        if self.device.is_cuda:
            bands = -(-height // ROWS_ON_CUDA)
            self._launch(view, (bands, self.triangles), self.all, 0, ROWS_ON_CUDA)
            wp.synchronize_device(self.device)
        else:
            self._draw_bands(view)

    def _each_part(self, kernel: Any, n: int, arguments: Any) -> None:
        step = n if self.device.is_cuda else TRIANGLES_PER_LAUNCH
        run_all([partial(wp.launch, kernel, dim=min(step, n - first), inputs=arguments(first), device=self.device)
                 for first in range(0, n, step)], self.threads)

    def _draw_bands(self, view: Any) -> None:
        """Draw bands of pixel rows in parallel on the CPU. One thread draws a whole band, so no two threads write the same pixel."""
        boxes = self.boxes.numpy()
        visible = np.flatnonzero(boxes[:, 0] <= boxes[:, 2]).astype(np.int32)
        top, bottom = boxes[visible, 1], boxes[visible, 3]
        bands = min(BANDS_PER_THREAD * self.threads, view.height)
        rows = -(-view.height // bands)

        def draw(first: int) -> None:
            in_band = visible[(top < first + rows) & (bottom >= first)]
            if len(in_band):
                self._launch(view, (1, len(in_band)), wp.array(in_band, dtype=wp.int32, device=self.device), first, rows)

        run_all([partial(draw, first) for first in range(0, view.height, rows)], self.threads)

    def _launch(self, view: Any, dim: tuple[int, int], prim_ids: Any, first: int, rows: int) -> None:
        wp.launch(kernels.rasterize, dim=dim, device=self.device, inputs=[
            view, self.projected, self.faces, self.boxes, prim_ids, wp.vec2i(first, rows), self.keys])

    def depth(self) -> np.ndarray:
        return self._half(1, np.float32)

    def prim_id(self) -> np.ndarray:
        return self._half(0, np.int32)

    def _half(self, which: int, dtype: Any) -> np.ndarray:
        halves = self.keys.numpy().astype("<u8", copy=False).view("<u4").reshape(-1, 2)[:, which]
        return np.ascontiguousarray(halves).view(dtype).reshape(self.size[1], self.size[0])


class RayCaster:
    """The results of Rasterizer by ray casting: call `draw`, then `depth` and `prim_id`. It builds its own acceleration structure."""

    def __init__(self, geometry: Geometry, accel: str = "bvh", device: str = "cpu", threads: int | None = None) -> None:
        ACCELERATORS.check(accel, "accel")
        self.accel, self.threads = build(geometry, accel, device, threads), threads
        self.view: tuple[CameraKind | None, tuple[int, int]] = None, (0, 0)  # camera and picture size of the rays

    def draw(self, camera: CameraKind, size: tuple[int, int]) -> None:
        """Cast a ray from the centre of the lens through each pixel's centre. Calls with the same camera and size reuse the rays."""
        if self.view != (camera, size):
            self.origins, self.directions = (wp.array(rays, dtype=wp.vec3, device=self.accel.device)
                                             for rays in camera_rays(as_perspective(camera), size))
            self.view = camera, size
        self.hits = self.accel.closest_hit(self.origins, self.directions, threads=self.threads)
        if self.accel.device.is_cuda:
            wp.synchronize_device(self.accel.device)

    def depth(self) -> np.ndarray:
        return self.hits.t.numpy().reshape(self.view[1][::-1])

    def prim_id(self) -> np.ndarray:
        return self.hits.prim_id.numpy().reshape(self.view[1][::-1])
