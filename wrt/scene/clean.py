"""Clean a mesh for tracing: remove faces without area and vertices without a face."""

from typing import Any, NamedTuple

import numpy as np

from wrt.core.errors import InputError

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

    Here, neighbours of a collinear face are found by equal coordinates, and all copies of a neighbour are split.
    vertices: (V, 3), converted to float32; faces: (F, 3) integers; normals (V, 3), uvs (V, 2) and face_group (F,) or None.
    Remaining faces and vertices keep their order. Faces with a NaN or infinite corner stay, and `Mesh` refuses them. Raises InputError
    that names the first face with an index outside [0, V)."""
    vertices = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    faces = np.asarray(faces).reshape(-1, 3)
    require_indices(faces, len(vertices))
    with_area = has_area(vertices, faces)
    dropped = 0
    if not with_area.all():
        source, dropped = np.flatnonzero(with_area), int(np.count_nonzero(~with_area))
        if len(_longest_edges(vertices, faces, np.flatnonzero(~with_area))[0]):
            (vertices, *rows), faces, source, dropped = _split([vertices, normals, uvs], faces, with_area)
            normals, uvs = rows
        else:
            faces = faces.take(source, axis=0)
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


def whole_numbers(*arrays: np.ndarray) -> tuple[list[list[Any]], int]:
    """Return each (3, N) array of float32 values as 3 object arrays of Python ints, and the exponent k of all arrays: value = int * 2^k."""
    parts = [np.frexp(array) for array in arrays]
    used = [exponent[mantissa != 0.0] for mantissa, exponent in parts]
    k = min((int(e.min()) for e in used if e.size), default=0) - 24
    out = []
    for mantissa, exponent in parts:
        whole = (mantissa * 2.0**24).astype(np.int64).astype(object)
        shift = np.where(mantissa != 0.0, exponent - 24 - k, 0).astype(object)
        out.append(list(whole << shift))
    return out, k


def merged(vertices: np.ndarray) -> np.ndarray:
    """Return for each vertex the first vertex with equal coordinates, (V,) int64. vertices: (V, 3) float32; -0 equals 0."""
    x, y, z = (vertices + np.float32(0.0)).view(np.uint32).T.astype(np.int64)
    pair = np.unique(x << 32 | y, return_inverse=True)[1]
    _, first, number = np.unique(pair << 32 | z, return_index=True, return_inverse=True)
    return first[number]


def copies(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of each set of faces with the same corners, in any order, (G,), and the set of each face, (F,)."""
    low, middle, high = np.sort(faces, axis=1).T.astype(np.int64)
    pair = np.unique(low << 32 | middle, return_inverse=True)[1]
    return np.unique(pair << 32 | high, return_index=True, return_inverse=True)[1:]


def windings(faces: np.ndarray) -> np.ndarray:
    """Return 1 or -1 for each face, (F,): copies with equal winding have the same sign. 0: two corners are equal."""
    a, b, c = faces.T
    return np.sign(b - a) * np.sign(c - b) * np.sign(c - a)


def _split(rows: list[Any], faces: np.ndarray, with_area: np.ndarray) -> tuple[list[Any], np.ndarray, np.ndarray, int]:
    """Flip the collinear faces of `clean`. rows: vertices, normals and uvs.

    Returns rows, the parts (K, 3) with area of all faces, the face of each part (K,), and the number of dropped faces. A new corner of a
    part gets normals and uvs of its own, interpolated, unless there is only one vertex at its place."""
    vertices = rows[0]
    same = merged(vertices)
    corners, count, gone = same[faces], with_area.astype(np.int64), ~with_area
    touched = np.zeros(len(vertices), bool)
    touched[corners[gone]] = True
    near = np.flatnonzero((touched[corners].sum(axis=1) > 1) & (with_area | (windings(corners) != 0)))
    first, kind = copies(corners[near])
    flipped, parent, without = _flipped(vertices, corners[near[first]], gone[near[first]])
    gone[near] = without[kind]
    part = np.flatnonzero(~without)
    part = part[np.argsort(parent[part], kind="stable")]
    begin = np.searchsorted(parent[part], np.arange(len(first) + 1))
    count[near] = np.diff(begin)[kind]
    source = np.repeat(np.arange(len(faces)), count)
    parts, cut = faces[source], np.flatnonzero(count[source] > 1)
    whole, place, begin_of = source[cut], np.searchsorted(near, source[cut]), np.cumsum(count) - count
    new = flipped[part[begin[kind[place]] + cut - begin_of[whole]]]
    turned = windings(corners[whole]) != windings(corners[near[first[kind[place]]]])
    new[turned] = new[turned][:, ::-1]
    found = new[:, :, None] == corners[whole][:, None, :]
    parts[cut] = np.where(found.any(axis=2), np.take_along_axis(faces[whole], np.argmax(found, axis=2), axis=1), new)
    inner = np.nonzero(~found.any(axis=2) & (np.bincount(same)[new] > 1))
    if len(inner[0]) and not rows[1] is rows[2] is None:
        p, q, r = (vertices[faces[whole[inner[0]], i]].astype(np.float64) for i in range(3))
        x = vertices[new[inner]]
        normal = np.cross(q - p, r - p)
        weights = [np.einsum("ij,ij->i", np.cross(*edges), normal)[:, None] for edges in ((q - x, r - x), (r - x, p - x), (p - x, q - x))]
        rows = [None if row is None else np.concatenate([row, (sum(w * row[faces[whole[inner[0]], i]] for i, w in enumerate(weights))
                / sum(weights)).astype(row.dtype)]) for row in rows]
        rows[0][len(vertices):] = x
        parts[cut[inner[0]], inner[1]] = np.arange(len(vertices), len(rows[0]))
    return rows, parts, source, int(np.count_nonzero(gone))


def flip_collinear(vertices: np.ndarray, faces: np.ndarray, by_place: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Flip the longest edge of each face with collinear corners; the surface stays the same.

    A collinear face (a, b, c), b between a and c, has no area, but it splits the edge from a to c in two. Without this face, its
    neighbour (a, c, d) would share no edge with the faces on the other side, and rays could pass between them by rounding. The flip
    replaces the face and its neighbour by (a, b, d) and (b, c, d): as many faces, and the same area.

    vertices: (V, 3) float32; faces: (F, 3). Returns faces (F, 3) of the same dtype, and source (F,). Returned face i lies in input
    face source[i], whose material and group apply to it. Faces with two equal corners stay as they are. So do faces whose
    longest edge does not belong to exactly two faces. by_place: vertices at the same place are one."""
    without = ~has_area(vertices, faces)
    if not (by_place and without.any()):
        return _flipped(vertices, faces, without)[:2]
    same = merged(vertices)[faces]
    flipped, source, _ = _flipped(vertices, same, without)
    return np.where((flipped == same).all(axis=1)[:, None], faces, flipped).astype(faces.dtype, copy=False), source


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
