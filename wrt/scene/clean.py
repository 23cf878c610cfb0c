"""Clean a mesh for tracing: remove faces without area and vertices without a face."""

from typing import NamedTuple

import numpy as np

from wrt.core.errors import InputError
from wrt.scene.exact import whole_numbers

AT_ONCE = 1 << 15  # faces of one batch, whose float64 temporaries fit in the processor's cache
ROUNDS = 64  # largest number of rounds of flips


class Cleaned(NamedTuple):
    """Arrays of a mesh after `clean`, and the number of dropped faces."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    face_group: np.ndarray | None
    dropped: int


def clean(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None, uvs: np.ndarray | None = None,
          face_group: np.ndarray | None = None) -> Cleaned:
    """Flip collinear faces (`flip_collinear`), drop faces whose area is exactly zero, then drop unused vertices.

    vertices: (V, 3), converted to float32; faces: (F, 3) integers; normals (V, 3), uvs (V, 2) and face_group (F,) or None.
    Remaining faces and vertices keep their order. Faces with a NaN or infinite corner stay, and `Mesh` refuses them. Raises InputError
    that names the first face with an index outside [0, V)."""
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    faces = np.asarray(faces).reshape(-1, 3)
    require_indices(faces, len(vertices))
    with_area = has_area(vertices, faces)
    dropped = 0
    if not with_area.all():
        faces, source, without = _flipped(vertices, faces, ~with_area)
        dropped = int(np.count_nonzero(without))
        kept = np.flatnonzero(~without)
        faces, source = faces.take(kept, axis=0), source.take(kept)
        face_group = face_group[source] if face_group is not None else None

    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if not used.all():
        faces = (np.cumsum(used, dtype=np.int32) - np.int32(1))[faces]
        vertices = vertices[used]
        normals = normals[used] if normals is not None else None
        uvs = uvs[used] if uvs is not None else None
    return Cleaned(vertices, faces.astype(np.int32, copy=False), normals, uvs, face_group, dropped)


def require_indices(faces: np.ndarray, count: int, place: str | None = None) -> None:
    """Raise InputError, which names the first wrong face, unless faces (F, 3) hold indices of `count` vertices."""
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        face = int(np.argmax(((faces < 0) | (faces >= count)).any(axis=1)))
        raise InputError(f"face {face} is {faces[face].tolist()}, but there are {count} vertices", argument="faces", place=place)


def has_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return exact (F,) bool: True for a face whose corners are not collinear, or not all finite. vertices: (V, 3) float32."""
    out = np.ones(len(faces), dtype=bool)
    for first in range(0, len(faces), AT_ONCE):
        part = faces[first:first + AT_ONCE]
        out[first:first + AT_ONCE] = corners_have_area(*(vertices.take(part[:, i], axis=0) for i in range(3)))
    return out


def corners_have_area(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return `has_area` of triangles with corners p, q, r, (N, 3) float32 each; fastest if 24 N float64 fit in the processor's cache.

    The cross product of two edges is computed in float64, and again in integers if no component exceeds its rounding error."""
    a, b, c = (np.array(corner.T, np.float64, order="C") for corner in (p, q, r))
    out = np.ones(len(p), dtype=bool)
    unknown: np.ndarray | slice = slice(None)
    with np.errstate(invalid="ignore"):
        e, f = b - a, c - a
        for i, j in ((1, 2), (2, 0), (0, 1)):
            left, right = e[i, unknown] * f[j, unknown], e[j, unknown] * f[i, unknown]
            # Error bound: two roundings in the factors of each product and one in the product. A comparison with NaN is False.
            doubt = np.flatnonzero(np.abs(left - right) <= 2.0**-50 * (np.abs(left) + np.abs(right)))
            unknown = doubt if isinstance(unknown, slice) else unknown[doubt]
            if not len(unknown):
                return out
    out[unknown] = _has_area_exactly(a[:, unknown], b[:, unknown], c[:, unknown])
    return out


def _has_area_exactly(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return `has_area` in integer arithmetic, for corners (3, N) float64 that hold float32 values."""
    finite = (np.isfinite(a) & np.isfinite(b) & np.isfinite(c)).all(axis=0)
    out = ~finite | ~((a == b).all(axis=0) | (b == c).all(axis=0) | (c == a).all(axis=0))
    rows = np.flatnonzero(out & finite)
    if len(rows):
        (p, q, r), _ = whole_numbers(a[:, rows], b[:, rows], c[:, rows])
        e, f = ([x - y for x, y in zip(corner, p, strict=True)] for corner in (q, r))
        out[rows] = np.any([e[i] * f[j] != e[j] * f[i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=0)
    return out


def flip_collinear(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flip the longest edge of each face with collinear corners; the surface stays the same.

    A collinear face (a, b, c), b between a and c, has no area, but it splits the edge from a to c in two. Without this face, its
    neighbour (a, c, d) would share no edge with the faces on the other side, and rays could pass between them by rounding. The flip
    replaces the face and its neighbour by (a, b, d) and (b, c, d): as many faces, and the same area.

    vertices: (V, 3) float32; faces: (F, 3). Returns faces (F, 3) of the same dtype, and source (F,). Returned face i lies in input
    face source[i], whose material and group apply to it. Faces with two equal corners stay as they are, and so do faces whose
    longest edge does not belong to exactly two faces."""
    return _flipped(vertices, faces, ~has_area(vertices, faces))[:2]


def _flipped(vertices: np.ndarray, faces: np.ndarray, without: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return faces and source of `flip_collinear`, and (F,) bool: True for faces that still have no area. without: the same of `faces`."""
    faces, source = faces.copy(), np.arange(len(faces))
    suspects, without = source.copy(), without.copy()
    for _ in range(ROUNDS if without.any() else 0):
        flat, ends, middle = _longest_edges(vertices, faces, suspects[without[suspects]])
        if not len(flat):
            break
        neighbour = _across(faces, flat, ends, len(vertices))
        # A flat neighbour must have the same longest edge; otherwise its own flip comes first.
        place = np.full(len(faces), -1)
        place[flat] = np.arange(len(flat))
        other = place[neighbour]
        ready = (neighbour >= 0) & ((other < 0) | (np.sort(ends) == np.sort(ends[other])).all(axis=1))
        flat, ends, middle, neighbour = (x[ready] for x in (flat, ends, middle, neighbour))
        # A face takes part in one flip a round: that of the flat face with the lowest index.
        first = np.full(len(faces), len(faces))
        for side in (flat, neighbour):
            np.minimum.at(first, side, flat)
        mine = (first[flat] == flat) & (first[neighbour] == flat)
        flat, ends, middle, neighbour = (x[mine] for x in (flat, ends, middle, neighbour))
        if not len(flat):
            break
        row, corners = np.arange(len(flat)), faces[neighbour]
        apex = np.argmin((corners[:, :, None] == ends[:, None, :]).any(axis=2), axis=1)
        d, p, q = (corners[row, (apex + i) % 3] for i in range(3))  # same orientation as the neighbour
        faces[flat], faces[neighbour] = np.stack([p, middle, d], axis=1), np.stack([middle, q, d], axis=1)
        source[flat] = source[neighbour]
        suspects = np.union1d(suspects[place[suspects] >= 0], neighbour)
        without[suspects] = ~has_area(vertices, faces[suspects])
    return faces, source, without


def _longest_edges(vertices: np.ndarray, faces: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which faces in `flat` have distinct corners (N,), the ends (N, 2) of their longest edges, and their third corners (N,)."""
    corners = vertices[faces[flat]].astype(np.float64)
    edges = np.stack([corners[:, (i + 2) % 3] - corners[:, (i + 1) % 3] for i in range(3)], axis=1)  # edge opposite corner i
    apart = (edges != 0.0).any(axis=2).all(axis=1)
    flat = flat[apart]
    middle = np.argmax(np.abs(edges[apart]).max(axis=2), axis=1)
    ends = np.stack([faces[flat, (middle + i) % 3] for i in (1, 2)], axis=1)
    return flat, ends, faces[flat, middle]


def _across(faces: np.ndarray, flat: np.ndarray, ends: np.ndarray, n_vertices: int) -> np.ndarray:
    """Return the other face (N,) at the edge `ends` (N, 2) of each face in `flat` (N,); -1 unless exactly two faces share the edge."""

    def key(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.minimum(p, q).astype(np.int64) * n_vertices + np.maximum(p, q)

    wanted = key(ends[:, 0], ends[:, 1])
    known = np.unique(wanted)
    owners = [np.zeros((2, 0), np.int64)]
    for i in range(3):
        edge = key(faces[:, i], faces[:, (i + 1) % 3])
        found = np.flatnonzero(np.isin(edge, known))
        owners.append(np.stack([np.searchsorted(known, edge[found]), found]))
    edge, face = np.concatenate(owners, axis=1)
    count, total = np.bincount(edge, minlength=len(known)), np.zeros(len(known), np.int64)
    np.add.at(total, edge, face)
    at = np.searchsorted(known, wanted)
    return np.where(count[at] == 2, total[at] - flat, -1)
