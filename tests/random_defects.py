"""Random defects of closed meshes: copies of faces, T joints, collinear faces, flips, vertices that are not shared.

Each defect leaves the solid as it is. So exact arithmetic on the sound mesh gives the right answers for the mesh with defects: of rays,
`contains`, `signed_distance` and `winding_number`, through every mesh format. `python -m tests.random_defects` checks ten thousand cases.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

import wrt
from tests import random_cases
from tests.gltf_files import GltfFile
from wrt.core.errors import InputError
from wrt.lab.oracle.oracle import Place, Reference
from wrt.scene import shapes
from wrt.scene.mesh import Mesh

FORMATS = ("arrays", ".npz", ".obj", ".ply", ".stl", ".off", ".glb")
STEP = 2.0**-7  # of the sound mesh's coordinates: points at quarters of an edge have no rounding
POINTS, RAYS, AIMED = 24, 300, 200
TURNS = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
Rng = np.random.Generator


@dataclass(frozen=True)
class Case:
    """A sound closed mesh that faces outwards, and the same surface with defects."""

    sound: Mesh
    shells: int
    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray  # (J, 2, 3): ends of edges that have a T joint.
    flipped: bool  # Some faces have the wrong winding.
    both: bool  # Some faces have copies of both windings.


def on_lattice(mesh: Mesh) -> Mesh:
    """Return the mesh with coordinates that are multiples of STEP, and each vertex once."""
    vertices = np.round(mesh.vertices / STEP) * STEP
    vertices, vertex = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    return Mesh(vertices, vertex.reshape(-1)[mesh.faces])


def sound_mesh(rng: Rng) -> tuple[Mesh, int]:
    """Return a mesh and its number of shells."""
    ball, box = shapes.icosphere(int(rng.integers(0, 3))), shapes.box()
    hollow = shapes.icosphere(1, 0.5)
    kinds = [ball, box, shapes.torus(segments=8, tube_segments=6), shapes.merged([ball, Mesh(hollow.vertices, hollow.faces[:, ::-1])], ""),
             shapes.merged([box, Mesh(box.vertices + np.float32([1, 0, 0]) * np.ptp(box.vertices[:, 0]), box.faces)], "")]
    kind = rng.integers(len(kinds))
    return on_lattice(kinds[kind]), 1 if kind < 3 else 2


def with_joints(rng: Rng, vertices: np.ndarray, faces: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split faces at points of an edge; collinear faces close the joints to the faces on the other side. No face is split twice."""
    points, added, joints = [*vertices], [], []
    out, free = list(map(tuple, faces.tolist())), np.ones(len(faces), bool)
    side = {(face[i], face[(i + 1) % 3]): row for row, face in enumerate(out) for i in range(3)}
    shared = Counter(tuple(sorted(edge)) for face in out for edge in combinations(face, 2))
    for row in rng.permutation(len(faces)):
        a, b, apex = np.roll(faces[row], rng.integers(3)).tolist()
        other = side.get((b, a), -1)
        if not free[row] or other < 0 or shared[tuple(sorted((a, b)))] > 2 or rng.random() > share:
            continue
        free[[row, other]] = False
        middles = [len(points) + i for i in range(int(rng.integers(1, 4)))]
        points += [vertices[a] + (vertices[b] - vertices[a]) * np.float32((i + 1) / 4) for i in range(len(middles))]
        chain = [a, *middles, b]
        out[row] = (a, chain[1], apex)
        added += [(p, q, apex) for p, q in pairwise(chain[1:])]
        added += [(a, q, p) for p, q in pairwise(chain[1:])]  # a fan of collinear faces
        joints.append((vertices[a], vertices[b]))
    return np.array(points), np.array(out + added), np.array(joints).reshape(-1, 2, 3)


def with_stray_faces(rng: Rng, vertices: np.ndarray, faces: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add fans without area at edges (E, 2), and faces with equal corners."""
    points, added = [*vertices], []
    for a, b in edges:
        added.append((a, b, len(points)))
        points.append((vertices[a] + vertices[b]) / 2)
        added += [(a, a, b), (b, b, b)][:rng.integers(0, 3)]
    return np.array(points), np.concatenate([faces, np.array(added, faces.dtype).reshape(-1, 3)])


def copied(rng: Rng, faces: np.ndarray, share: float, both: bool) -> np.ndarray:
    """Return the faces and one to three copies of some, with rotated corners. both: one copy more may have the opposite winding."""
    chosen = faces[rng.random(len(faces)) < share] if share < 1.0 else np.tile(faces, (rng.integers(1, 3), 1))
    again = np.take_along_axis(chosen, TURNS[rng.integers(3, size=len(chosen))], axis=1)
    if both:
        opposite = np.ones(len(again), bool) if share == 1.0 and len(again) == len(faces) else rng.random(len(again)) < 0.5
        opposite &= np.arange(len(again)) < len(faces)  # at most half of the copies
        again[opposite] = again[opposite, ::-1]
    elif share < 1.0:
        again = np.concatenate([again, again[rng.random(len(again)) < 0.5]])
    return np.concatenate([faces, again])


def draw(rng: Rng) -> Case:
    sound, shells = sound_mesh(rng)
    vertices, faces, joints = sound.vertices, sound.faces, np.zeros((0, 2, 3))
    if rng.random() < 0.6:
        vertices, faces, joints = with_joints(rng, vertices, faces, rng.choice([0.1, 0.5, 1.0]))
    ends = {tuple(map(tuple, joint)) for joint in joints.tolist()}
    if flipped := rng.random() < 0.3:
        which = rng.random(len(faces)) < 0.3
        faces[which] = faces[which, ::-1]
    stray = [(a, b) for a, b, _ in faces[rng.random(len(faces)) < 0.1] if not ends] if rng.random() < 0.4 else []
    kept = faces
    both = False
    if rng.random() < 0.7:
        both = bool(rng.random() < 0.5)
        kept = copied(rng, faces, rng.choice([0.05, 0.5, 1.0]), both)
    vertices, faces = with_stray_faces(rng, vertices, kept, np.array(stray, np.int64).reshape(-1, 2))
    faces = faces[rng.permutation(len(faces))]
    if (own := rng.random()) < 0.6:  # all faces, or some, get their own vertices
        some = rng.random(len(faces)) < (1.0 if own < 0.4 else 0.5)
        apart = faces[some]
        faces[some] = len(vertices) + np.arange(apart.size).reshape(-1, 3)
        vertices = np.concatenate([vertices, vertices[apart].reshape(-1, 3)])
    vertices = np.float32(vertices)
    zero = (vertices == 0.0) & (rng.random(vertices.shape) < 0.5)
    vertices[zero] = -0.0
    return Case(sound, shells, vertices, faces.astype(np.int32), joints, flipped, both)


def built(case: Case, form: str) -> Any:
    if form == "arrays":
        return wrt.build((case.vertices, case.faces))
    with tempfile.TemporaryDirectory() as folder:
        path, mesh = Path(folder) / f"mesh{form}", Mesh(case.vertices, case.faces)
        if form == ".glb":
            file = GltfFile()
            file.mesh(file.primitive(case.vertices, case.faces.reshape(-1)))
            file.node(mesh=0)
            file.write(Path(folder), path.name)
        else:
            mesh.save(path)
        return wrt.build(path)


def exact_inside(corners: np.ndarray, point: np.ndarray) -> bool:
    """Return whether a ray crosses triangles (F, 3, 3) an odd number of times, in fractions."""
    def det(a: list[Fraction], b: list[Fraction], c: list[Fraction]) -> Fraction:
        return (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]))

    direction = [Fraction(1), Fraction(1, 1009), Fraction(1, 7001)]
    crossed = 0
    for triangle in corners.tolist():
        a, b, c = ([Fraction(x) - Fraction(float(o)) for x, o in zip(corner, point, strict=True)] for corner in triangle)
        sides = [det(direction, p, q) for p, q in ((a, b), (b, c), (c, a))]
        slope = sum(sides)
        if all(s > 0 for s in sides) or all(s < 0 for s in sides):
            crossed += det(a, b, c) / slope > 0
        else:
            assert all(s != 0 for s in sides) or not (all(s >= 0 for s in sides) or all(s <= 0 for s in sides)), "the ray meets an edge"
    return crossed % 2 == 1


def winding(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the sum of solid angles over 4 pi, by van Oosterom and Strackee."""
    a, b, c = (corners[None, :, i].astype(np.float64) - points[:, None].astype(np.float64) for i in range(3))
    x, y, z = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    below = x * y * z + (a * b).sum(2) * z + (b * c).sum(2) * x + (c * a).sum(2) * y
    return np.arctan2((a * np.cross(b, c)).sum(2), below).sum(axis=1) / (2.0 * np.pi)


def rays_of(rng: Rng, case: Case, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rays from points inside to joints or other edges, and in random directions."""
    corners = case.sound.vertices[case.sound.faces]
    edges = case.joints if len(case.joints) else corners[:, :2]
    edge = edges[rng.integers(len(edges), size=RAYS)]
    goal = edge[:, 0] + rng.random((RAYS, 1)) * (edge[:, 1] - edge[:, 0])
    origins = np.float32(inside[rng.integers(len(inside), size=RAYS)])
    directions = np.where(np.arange(RAYS)[:, None] < AIMED, goal - origins, rng.normal(size=(RAYS, 3)))
    return origins, np.float32(directions)


def problems(form: str, seed: int) -> Iterator[str]:
    rng = np.random.default_rng((FORMATS.index(form), seed))
    case = draw(rng)
    corners = case.sound.vertices[case.sound.faces]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    points = np.float32(rng.uniform(low - 0.2, high + 0.2, (POINTS, 3)))
    truth = np.array([exact_inside(corners, point) for point in points])
    accel = built(case, form)
    try:
        inside = wrt.contains(accel, points)
    except InputError:
        if len(case.sound.faces) == 24 and len(case.joints):  # joints at the wall between two boxes: docs/accuracy.md, "Known limits"
            return
        raise
    if (wrong := np.flatnonzero(inside != truth)).size:
        yield f"contains of {len(wrong)} points: {points[wrong[0]]}, expected {truth[wrong[0]]}"
    if (np.signbit(wrt.signed_distance(accel, points)) != truth).any():
        yield "signed_distance"
    turned = winding(corners, points)
    if not case.flipped and not (case.both and case.shells > 1):  # else windings do not say which shell is a hole
        for exact in (True, False):
            off = np.abs(wrt.winding_number(accel, points, exact=exact) - turned).max()
            if off > (1e-6 if exact else 2e-3):
                yield f"winding_number, exact {exact}: off by {off}"
        if (np.signbit(wrt.signed_distance(accel, points, sign="winding")) != (turned > 0.5)).any():
            yield "signed_distance by winding"
    if not truth.any():
        return
    origins, directions = rays_of(rng, case, points[truth])
    hits = accel.closest_hit(origins, directions)
    lost = ~hits.hit
    if lost.any() and not (form in ("arrays", ".npz") and len(case.joints)):  # docs/accuracy.md, "Known limits"
        yield f"{lost.sum()} of {RAYS} rays lost"
    right = Reference(case.sound).closest(origins, directions)
    clear = (right.place == Place.INSIDE) & ~lost & (np.arange(RAYS) >= AIMED)
    if (off := np.abs(hits.t - right.t)[clear] > 1e-5 * right.t[clear] + 1e-6).any():
        yield f"t of {off.sum()} rays"


def check(group: int, seed: int) -> str:
    """Return a description of the differences of a case; "" without any."""
    return "; ".join(problems(FORMATS[group % len(FORMATS)], seed + 1000 * (group // len(FORMATS))))


if __name__ == "__main__":
    random_cases.main(__doc__, check, 100)
