"""Triangle meshes, validated on construction, and their conversion from and to trimesh."""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from wrt.core.checks import LARGEST, as_array, as_names, as_path, shown
from wrt.core.errors import InputError
from wrt.core.files import checksum_of, write_bytes
from wrt.core.packages import needed_by
from wrt.core.types import PathLike
from wrt.scene.clean import has_area, require_indices
from wrt.scene.values import as_vector, near_zero, warn_if_far

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in object space.

    Parameters
    ----------
    vertices
        (V, 3), stored as float32; finite, at most 1e30 in absolute value. From float64 vertices far from 0, `origin` is subtracted first.
    faces
        (F, 3) indices of vertices, stored as int32; counter-clockwise seen from outside.
    normals
        (V, 3) unit vectors for smooth shading, or None for flat shading. A zero normal means flat shading at its vertex.
    uvs
        (V, 2) texture coordinates, or None; (0, 0) is the top left of an image.
    groups, face_group
        Names of the parts of the mesh; and the index of each face's part (F,), or None.
    dropped
        Number of faces that the loader left out: their area is exactly zero, or they have fewer than three corners.
    origin
        (3,) float64, which `positions` adds to the vertices, or None: 0. It is chosen for float64 vertices whose distance from 0 is more
        than 32 times half their extent.

    Raises
    ------
    InputError
        If an array has a wrong shape, a wrong type or a value out of range; the message names the first wrong row.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    groups: tuple[str, ...] = ()
    face_group: np.ndarray | None = None
    dropped: int = 0
    name: str = ""
    origin: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.origin is None:
            with contextlib.suppress(ValueError, TypeError, IndexError):
                raw = np.asarray(self.vertices)
                if raw.dtype.kind in "fiu" and raw.shape[1:] == (3,):
                    near, origin = near_zero(raw, np.asarray(self.faces))
                    if origin is not None:
                        object.__setattr__(self, "vertices", near)
                        object.__setattr__(self, "origin", origin)
        else:
            object.__setattr__(self, "origin", np.array(as_vector(self.origin, "origin")))
        object.__setattr__(self, "groups", as_names(self.groups, ": ".join(part for part in (self.name, "groups") if part)))
        vertices = self._array("vertices", np.float32, 3)
        faces = self._array("faces", np.int32, 3)
        _require_finite(vertices, self.name, "vertices")
        place = self.name or None
        if self.reach > np.float32(LARGEST):
            row = int(np.argmax(np.abs(vertices).max(axis=1)))
            raise InputError(f"must be at most {LARGEST:g}, but row {row} is {vertices[row].tolist()}", argument="vertices", place=place)
        require_indices(faces, len(vertices), place)
        for attribute, width in (("normals", 3), ("uvs", 2)):
            if getattr(self, attribute) is not None:
                array = self._array(attribute, np.float32, width)
                if len(array) != len(vertices):
                    raise InputError(f"must have {len(vertices)} rows like the vertices, got {len(array)}", argument=attribute, place=place)
                _require_finite(array, self.name, attribute)
        if self.face_group is not None:
            group = as_array(self.face_group, np.int32, "face_group")
            if group.shape != (len(faces),) or (group.size and not 0 <= group.min() <= group.max() < len(self.groups)):
                what = f"must be ({len(faces)},) indices of {len(self.groups)} groups, got {shown(group)}"
                raise InputError(what, argument="face_group", place=place)
            object.__setattr__(self, "face_group", group)

    def _array(self, attribute: str, dtype: type, width: int) -> np.ndarray:
        try:
            raw = np.asarray(getattr(self, attribute))
        except ValueError:
            raise InputError(f"must be (N, {width}), got rows of different lengths", argument=attribute, place=self.name or None) from None
        if raw.ndim != 2 or raw.shape[1] != width:
            raise InputError(f"must be (N, {width}), got {raw.shape}", argument=attribute, place=self.name or None)
        if dtype is np.int32 and raw.size and not np.issubdtype(raw.dtype, np.integer):
            raise InputError(f"must hold integers, got {raw.dtype}", argument=attribute, place=self.name or None)
        array = as_array(raw, dtype, ": ".join(part for part in (self.name, attribute) if part))
        object.__setattr__(self, attribute, array)
        return array

    @classmethod
    def from_trimesh(cls, mesh: trimesh.Trimesh | trimesh.Scene, smooth: bool = False) -> Mesh:
        """Return the triangles of a trimesh mesh, or of a whole trimesh scene in world space.

        The result has the texture coordinates of the mesh, if there are any, and its vertex normals, scaled to unit length, if
        `smooth`. Faces without area stay, but rays never hit them. Raises InputError for any other object, and for arrays that `Mesh`
        refuses."""
        with needed_by("a mesh of trimesh"):
            import trimesh

        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        if not isinstance(mesh, trimesh.Trimesh):
            raise InputError(f"must be a trimesh.Trimesh or a trimesh.Scene, got {shown(mesh)}", argument="mesh")
        uv = getattr(mesh.visual, "uv", None)
        uvs = None if uv is None or len(uv) != len(mesh.vertices) else np.asarray(uv)[:, :2] * (1.0, -1.0) + (0.0, 1.0)
        source = getattr(mesh, "source", None)
        return cls(np.array(mesh.vertices), np.array(mesh.faces), unit_rows(np.array(mesh.vertex_normals)) if smooth else None, uvs,
                   name=str(getattr(source, "file_name", None) or ""))

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return a trimesh mesh with the same vertices and faces in the same order, and with normals and uvs if there are any."""
        with needed_by("a mesh of trimesh"):
            import trimesh

        visual = None if self.uvs is None else trimesh.visual.TextureVisuals(uv=self.uvs * (1.0, -1.0) + (0.0, 1.0))
        vertices = self.vertices if self.origin is None else self.positions
        return trimesh.Trimesh(vertices, self.faces, vertex_normals=self.normals, visual=visual, process=False)

    def save(self, path: PathLike) -> None:
        """Write vertices and faces to a file that `wrt.load_mesh` reads.

        .npz, .ply and .obj also have normals and uvs, and .npz has the groups. .npz keeps all bits. .obj, .off, .ply, .stl and .glb keep
        those of the vertices. trimesh may round in other formats (.dae: seven digits). A mesh with an origin keeps it in .npz, .obj and
        .off. Others round its positions to float32, with a warning.

        Parameters
        ----------
        path : str or path
            Suffixes other than .npz are those of trimesh, such as .ply, .obj, .stl and .off; these need trimesh.

        Raises
        ------
        InputError
            If trimesh cannot write the format, or the file cannot be written.
        """
        path = as_path(path, "path")
        if path.suffix.lower() == ".npz":
            arrays = {name: getattr(self, name) for name in ("vertices", "faces", "normals", "uvs", "origin")}
            if self.face_group is not None:
                arrays |= {"face_group": self.face_group, "groups": np.array(self.groups, np.str_)}
            data = io.BytesIO()
            np.savez(data, exact=np.True_, **{name: array for name, array in arrays.items() if array is not None})
            write_bytes(path, data.getvalue())
            return
        options: dict[str, Any] = {}
        if self.origin is not None and path.suffix.lower() not in (".obj", ".off"):
            warn_if_far(self.positions.astype(np.float32), str(path))
        if path.suffix.lower() in (".obj", ".off"):  # numbers without an exponent: nine digits of the smallest keep all bits of a float32
            smallest = np.abs(self.vertices).min(initial=1.0, where=self.vertices != 0.0)
            options["digits"] = 9 - math.floor(math.log10(smallest))
        try:
            written = self.to_trimesh().export(file_type=path.suffix.lower()[1:], **options)
        except (ValueError, KeyError) as error:
            raise InputError(f"trimesh does not write this format ({error})", path=path,
                             hint="use .npz, .ply, .obj, .stl or .off") from error
        if isinstance(written, dict):
            raise InputError("is of a format with several files", path=path, hint="use .npz, .ply, .obj, .stl, .off or .glb")
        write_bytes(path, written.encode() if isinstance(written, str) else written)

    @property
    def positions(self) -> np.ndarray:
        """Vertices plus `origin`: (V, 3) float64."""
        wide = self.vertices.astype(np.float64)
        return wide if self.origin is None else wide + self.origin

    @cached_property
    def reach(self) -> float:
        """Largest absolute coordinate of the vertices."""
        return float(np.abs(self.vertices).max(initial=0.0))

    @property
    def is_clean(self) -> bool:
        """Whether every face has an area, in exact arithmetic. `wrt.load_mesh` drops other faces.

        It is tested again after the caller has written to the arrays; their checksum takes a fifth of the test's time."""
        checksum, (tested, clean) = checksum_of(self.vertices, self.faces), self.__dict__.get("_clean", (None, False))
        if tested != checksum:
            clean = bool(has_area(self.vertices, self.faces).all())
            self.__dict__["_clean"] = checksum, clean
        return clean

    def note_clean(self) -> None:
        """Note that every face has an area, so that it need not be tested."""
        self.__dict__["_clean"] = checksum_of(self.vertices, self.faces), True

    def __repr__(self) -> str:
        parts = [repr(self.name)] if self.name else []
        parts += [f"{len(self.vertices)} vertices", f"{len(self.faces)} faces"]
        parts += [name for name in ("normals", "uvs") if getattr(self, name) is not None]
        parts += [f"{len(self.groups)} groups"] * bool(self.groups) + [f"{self.dropped} dropped"] * bool(self.dropped)
        if len(self.vertices):
            low, high = (end(axis=0) + (0.0 if self.origin is None else self.origin) for end in (self.vertices.min, self.vertices.max))
            parts.append(f"from {_corner(low)} to {_corner(high)}")
        return f"Mesh({', '.join(parts)})"


def _corner(point: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"


def _require_finite(array: np.ndarray, name: str, attribute: str) -> None:
    finite = np.isfinite(array)
    if not finite.all():
        bad = ~finite.all(axis=1)
        row = int(np.argmax(bad))
        raise InputError(f"must be finite, but row {row} is {array[row].tolist()} ({int(bad.sum())} such rows)",
                         argument=attribute, place=name or None)


def unit_rows(vectors: np.ndarray) -> np.ndarray:
    """Return (N, 3) float32 vectors scaled to unit length; zero vectors stay zero."""
    wide = vectors.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.divide(wide, length, out=np.zeros_like(wide), where=length > 0.0).astype(np.float32)


def smooth(mesh: Mesh) -> Mesh:
    """Return the mesh with smooth normals: the sum of the unit normals of adjacent faces, weighted by their angle at the vertex.

    Vertices at exactly the same position get the same normal, so that texture seams do not show. With these weights the normal
    does not depend on the triangulation (Thuermer and Wuethrich, "Computing vertex normals from polygonal facets", 1998). A sum that
    cancels out gives a zero normal (flat shading). A mesh with normals is returned unchanged."""
    if mesh.normals is not None:
        return mesh
    _, place = np.unique(mesh.vertices + np.float32(0.0), axis=0, return_inverse=True)  # -0 is 0
    place = place.reshape(-1)
    normals = corner_normals(mesh.vertices[mesh.faces], place[mesh.faces], int(place.max()) + 1)
    return replace(mesh, normals=normals[place].astype(np.float32))


def corner_normals(corners: np.ndarray, place: np.ndarray, count: int) -> np.ndarray:
    """Return the normals of `smooth` (count, 3) float64 at `count` places. corners: (F, 3, 3); place: (F, 3), the place of each corner."""
    points = corners.astype(np.float64)
    edges = np.roll(points, -1, axis=1) - points  # from each corner to the next
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    back = -np.roll(edges, 1, axis=1)
    sine = np.linalg.norm(np.cross(edges, back), axis=2)
    angle = np.arctan2(sine, (edges * back).sum(axis=2))

    weighted = normal[:, None, :] * angle[:, :, None]
    where = place.reshape(-1)
    total = np.stack([np.bincount(where, weighted[..., axis].reshape(-1), count) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-6, total / np.maximum(length, 1e-300), 0.0)
