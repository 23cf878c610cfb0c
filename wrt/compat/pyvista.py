"""The ray methods of PyVista's PolyData, implemented with wrt's queries, and conversions between PolyData and `wrt.Mesh`.

>>> from wrt.compat.pyvista import RayTracer
>>> points, rays, cells = RayTracer(polydata).multi_ray_trace(origins, directions)  # in place of polydata.multi_ray_trace
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wrt.accel.queries.all_hits import ALL
from wrt.compat.trimesh import RayMeshIntersector
from wrt.core.arrays import real_numbers
from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.core.types import ArrayLike
from wrt.scene.mesh import Mesh, unit_rows

if TYPE_CHECKING:
    import pyvista

END = 1e-12  # of a segment's length, or of the largest coordinate: a surface so near to an end is hit
NEAR_END = 2.0**-21  # of the mesh's size: a hit so near to an end on the surface is the same hit, whose point may be that of float32


class RayTracer:
    """The methods `multi_ray_trace` and `ray_trace` of a PolyData. docs/compat.md lists the differences.

    `wrt.compat.trimesh.RayMeshIntersector` finds the hits: points are computed in float64, and a ray that is not finite, or has
    direction 0, hits nothing. Both methods raise pyvista.NotAllTrianglesError for a mesh with other cells, and InputError for arrays of
    other shapes; both are ValueErrors.

    Parameters
    ----------
    mesh : pyvista.PolyData
        Mesh of triangles. After its points or faces change, the next call builds a new structure.
    device, threads
        See `wrt.build`.
    """

    def __init__(self, mesh: pyvista.PolyData, *, device: str = "cpu", threads: int | None = None) -> None:
        self.mesh, self._device, self._threads = mesh, device, threads
        # VTK's time of the last change, the mesh's points, and a copy of them.
        self._built: tuple[int, np.ndarray, np.ndarray, RayMeshIntersector] | None = None

    def multi_ray_trace(self, origins: ArrayLike, directions: ArrayLike, first_point: bool = False,
                        retry: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intersect rays with the mesh: the first hits in the order of the rays, then the second hits, and so on.

        Parameters
        ----------
        origins, directions : (N, 3) array_like
            Rays in the mesh's units; directions of any length.
        first_point
            Return only the first hit of each ray; otherwise at most 100 hits, as PyVista.
        retry
            Sort the rows by ray, and by distance within a ray. No ray is traced again, because no ray is lost.

        Returns
        -------
        tuple
            Point (M, 3) float64, ray (M,) int64 and cell (M,) int64 of each hit.
        """
        points, ray, cell = self._intersector("multi_ray_trace").intersects_location(origins, directions, multiple_hits=not first_point)
        order = np.argsort(ray, kind="stable") if retry else slice(None)
        return points[order], ray[order], cell[order]

    def ray_trace(self, origin: ArrayLike, end_point: ArrayLike, first_point: bool = False, plot: bool = False,
                  off_screen: bool | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Intersect a segment with the mesh; rows are in the order of distance from `origin`, each point once.

        An end that is on the surface, to within the rounding of the mesh's points, is hit. A segment may have length 0.

        Parameters
        ----------
        origin, end_point : (3,) array_like
            Ends of the segment in the mesh's units.
        first_point
            Return only the point nearest to `origin`, (3,); the cells remain.
        plot, off_screen
            `plot` must be False: nothing is drawn.

        Returns
        -------
        tuple
            Point (M, 3), in the dtype of the mesh's points, and cell (M,) int64 of each hit. (0, 3) and (0,) on a miss.
        """
        start, end = (np.asarray(real_numbers(value, name, "(3,)"), np.float64) for value, name in (
            (origin, "origin"), (end_point, "end_point")))
        if start.shape != (3,) or end.shape != (3,):
            raise InputError(f"and end_point must both be (3,), got {start.shape} and {end.shape}", argument="origin")
        if plot:
            raise InputError("must be False: this class draws nothing", argument="plot", hint="pass the points to a plotter of PyVista")
        tracer = self._intersector("ray_trace")
        where, _, cells = tracer.intersects_location(start[None], (end - start)[None], max_hits=ALL)
        scaled, dtype = tracer.scaled, self.mesh.points.dtype
        reach = max(float(np.finfo(dtype).eps), END) * np.abs([scaled.low, scaled.high]).max()
        near = reach + NEAR_END * (scaled.high - scaled.low).max()
        kept = (where - start) @ (end - start) <= (1.0 + END) * ((end - start) @ (end - start))
        first, last = scaled.face_at(start, reach), scaled.face_at(end, reach)
        for point, face in ((start, first), (end, last)):
            kept &= (face < 0) | (np.linalg.norm(where - point, axis=1) > near)
        kept = np.concatenate([[first >= 0], kept, [last >= 0]])
        points, cells = np.vstack([start, where, end])[kept].astype(dtype), np.concatenate([[first], cells, [last]])[kept]
        kept = np.append(True, (points[1:] != points[:-1]).any(axis=1))[:len(points)]
        points = points[kept]
        return points[0] if first_point and len(points) else points, cells[kept]

    def _intersector(self, method: str) -> RayMeshIntersector:
        """Return the ray class over the present mesh."""
        changed = self.mesh.GetMTime()
        # VTK's time does not notice `points += 1` on a view of the points.
        if self._built is None or self._built[0] != changed or not np.array_equal(*self._built[1:3]):
            import trimesh

            points, faces = _triangles(self.mesh, method)
            own = trimesh.Trimesh(np.array(points, np.float64), np.array(faces), process=False)
            intersector = RayMeshIntersector(own, device=self._device, threads=self._threads)
            self._built = self.mesh.GetMTime(), points, np.array(points), intersector
        return self._built[3]


def to_mesh(polydata: pyvista.PolyData) -> Mesh:
    """Return the triangles of a PolyData, in the same order, with its normals and texture coordinates if there are any.

    Parameters
    ----------
    polydata : pyvista.PolyData
        Mesh of triangles with finite points, which are rounded to float32; for other cells, pyvista.NotAllTrianglesError is raised.
    """
    points, faces = _triangles(polydata, "to_mesh")
    normals, uvs = polydata.point_data.active_normals, polydata.active_texture_coordinates
    return Mesh(np.array(points), np.array(faces), None if normals is None else unit_rows(np.array(normals)),
                None if uvs is None else np.array(uvs)[:, :2] * (1.0, -1.0) + (0.0, 1.0))  # VTK counts v upwards


def to_polydata(mesh: Mesh) -> pyvista.PolyData:
    """Return a PolyData with copies of a mesh's arrays, in the same order, with its normals and texture coordinates if there are any.

    Parameters
    ----------
    mesh : wrt.Mesh
        Mesh.

    Returns
    -------
    pyvista.PolyData
        Points (V, 3), float32 or, of a mesh with an origin, float64; and F triangles.
    """
    with needed_by("a mesh of PyVista"):
        import pyvista

    polydata = pyvista.PolyData.from_regular_faces((mesh.vertices if mesh.origin is None else mesh.positions).copy(), mesh.faces.copy())
    if mesh.normals is not None:
        polydata.point_data["Normals"] = mesh.normals.copy()
        polydata.GetPointData().SetActiveNormals("Normals")
    if mesh.uvs is not None:
        polydata.point_data["uvs"] = (mesh.uvs * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)
        polydata.GetPointData().SetActiveTCoords("uvs")
    return polydata


def _triangles(mesh: pyvista.PolyData, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 3) and faces (F, 3) of a mesh of triangles; PyVista's error for other meshes."""
    if not mesh.is_all_triangles:
        from pyvista.core.errors import NotAllTrianglesError

        raise NotAllTrianglesError(f"Input mesh for {method} must be all triangles." + " It has no cells." * (mesh.n_cells == 0))
    return np.asarray(mesh.points), np.asarray(mesh.regular_faces)
