"""A structure's scene as named arrays, for files of structures that hold their scene (wrt.accel.store)."""

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from wrt.accel.flat_scene import FlatScene, Placed, flat_scene_of, placed_now
from wrt.accel.geometry import MAX_SPREAD, Geometry, InstancedGeometry, NumberedGeometry, inverse_of, spread_of
from wrt.accel.snapshot import Snapshot
from wrt.core.errors import InputError

# Type and number of columns of each array; None: one dimension. The arrays of INSTANCED are in files of instances only.
ALWAYS: dict[str, tuple[str, int | None]] = {
    "vertices": ("<f4", 3), "faces": ("<i4", 3), "spheres": ("<f4", 4), "uvs": ("<f4", 2), "prim_material": ("<i4", None)}
OPTIONAL: dict[str, tuple[str, int | None]] = {
    "normals": ("<f4", 3), "objects": ("<i8", None), "worlds": ("<i8", None), "own_materials": ("<i8", 3), "prim_ids": ("<i4", None),
    "origin": ("<f8", None), "part_origins": ("<f8", 3)}
PLACED = "first_prim", "first_face", "first_material", "material_step"
INSTANCED: dict[str, tuple[str, int | None]] = {
    "part_sizes": ("<i8", 2), "part": ("<i4", None), "to_world": ("<f8", 12), "first_prim": ("<i8", None), "names": ("|u1", None),
    "placed": ("<i8", len(PLACED)), "placed_to_world": ("<f8", 12)}
KINDS = ALWAYS | OPTIONAL | INSTANCED


def arrays_of(snapshot: Snapshot) -> dict[str, np.ndarray]:
    """Return the arrays of a structure's scene, with the present vertices and places."""
    geometry, scene = snapshot.geometry, snapshot.attributes or flat_scene_of(snapshot.geometry)
    out: dict[str, Any] = {name: getattr(scene, name) for name in ("vertices", "faces", "uvs", "prim_material", "normals", "objects")}
    out |= {"spheres": geometry.spheres, "origin": geometry.origin}
    if isinstance(geometry, Geometry):
        out["vertices"] = geometry.vertices
    else:
        placed, first = placed_now(scene, geometry), geometry.parts[0]
        assert placed is not None
        if any(part.origin is not None for part in geometry.parts):
            out["part_origins"] = [np.zeros(3) if part.origin is None else part.origin for part in geometry.parts]
        out |= {"part_sizes": [(len(part.vertices), len(part.faces)) for part in geometry.parts], "part": geometry.part,
                "to_world": geometry.to_world.reshape(-1, 12), "first_prim": geometry.first_prim, "worlds": geometry.worlds,
                "prim_ids": first.prim_ids if isinstance(first, NumberedGeometry) else None,
                "names": np.frombuffer(json.dumps(scene.names).encode(), np.uint8), "own_materials": scene.own_materials,
                "placed": np.stack([getattr(placed, name) for name in PLACED], axis=1), "placed_to_world": placed.to_world.reshape(-1, 12)}
    return {name: _shaped(np.asarray(array), name) for name, array in out.items() if array is not None}


def _shaped(array: np.ndarray, name: str) -> np.ndarray:
    kind, columns = KINDS[name]
    return np.ascontiguousarray(array.reshape(-1) if columns is None else array.reshape(-1, columns), kind)


def scene_of(arrays: Mapping[str, np.ndarray]) -> FlatScene:
    """Make the scene of arrays from a file. Raises InputError for indices that lead out of an array, and for arrays of wrong lengths."""
    a = {name: _shaped(array, name).astype(np.dtype(KINDS[name][0]).newbyteorder("="), copy=False) for name, array in arrays.items()}
    _require(all(name in a for name in ALWAYS), "lacks an array")
    _require("normals" not in a or len(a["normals"]) == len(a["vertices"]), "has wrong normals")
    _require(len(a["uvs"]) in (0, len(a["vertices"])), "has wrong texture coordinates")
    _require("origin" not in a or (a["origin"].shape == (3,) and np.isfinite(a["origin"]).all()), "has a wrong origin")
    if "part" not in a:
        _require(_within(a["faces"], len(a["vertices"])), "has a face beyond its vertices")
        geometry = Geometry(a["vertices"], a["faces"], a["spheres"], a.get("origin"))
        _require(len(a["prim_material"]) == len(geometry) or "objects" not in a, "lacks materials")
        _check_ids(a, len(geometry))
        return FlatScene(geometry, geometry.vertices, geometry.faces, a.get("normals"), a["uvs"], a["prim_material"],
                         objects=a.get("objects"))
    _require(all(name in a for name in INSTANCED), "lacks an array")
    instanced = _geometry_of(a)
    runs = a["placed"]
    length = np.diff(np.append(runs[:, 0], len(instanced)))
    triangles = runs[:, 0] < instanced.n_triangles
    _require(len(runs) == len(a["placed_to_world"]) and (runs >= 0).all() and (length >= 0).all() and not runs[:1, 0].any()
             and len(runs) > 0 and (runs <= (len(instanced), len(a["faces"]), len(a["prim_material"]), 1)).all()
             and (runs[triangles, 1] + length[triangles] <= len(a["faces"])).all(), "has a face beyond its faces")
    placed = Placed(runs[:, 0], runs[:, 1], runs[:, 2], runs[:, 3], a["placed_to_world"].reshape(-1, 3, 4))
    places = np.concatenate([instanced.to_world, placed.to_world])
    with np.errstate(all="ignore"):
        _require(bool(np.isfinite(places).all()) and bool((np.linalg.det(places[:, :, :3]) != 0.0).all())
                 and bool((spread_of(places, inverse_of(places)) <= MAX_SPREAD).all()), "has a matrix that is no place")
    _check_ids(a, len(instanced))
    if "objects" in a or "own_materials" in a:
        _check_materials(a, instanced, runs[length > 0], length[length > 0])
    names = json.loads(a["names"].tobytes())
    count = len(a["objects"]) - len(instanced.spheres) if "objects" in a else len(instanced.part)
    _require(isinstance(names, list) and len(names) in (0, count) and all(isinstance(name, str) for name in names), "has wrong names")
    return FlatScene(instanced, a["vertices"], a["faces"], a.get("normals"), a["uvs"], a["prim_material"], placed, a.get("objects"),
                     a.get("own_materials"), tuple(names))


def _check_ids(a: Mapping[str, np.ndarray], n_primitives: int) -> None:
    """Check the first prim_ids of objects, and that no material has a negative index."""
    first = np.append(a.get("objects", np.zeros(1, np.int64)), n_primitives)
    _require(first[0] == 0 and (np.diff(first) >= 0).all() and (a["prim_material"] >= 0).all(), "has a wrong object or material")


def _check_materials(a: Mapping[str, np.ndarray], geometry: InstancedGeometry, runs: np.ndarray, length: np.ndarray) -> None:
    """Check that all primitives of runs, none of which is empty, have a material; over worlds one of their world's own materials."""
    last = runs[:, 2] + runs[:, 3] * (length - 1)
    _require((last < len(a["prim_material"])).all() and ("objects" in a) == (geometry.worlds is None), "lacks materials")
    if geometry.worlds is not None:
        own, begins = a["own_materials"], geometry.world_first_prim
        world, rows = (np.searchsorted(begins, runs[:, 0], "right") - 1).tolist(), list(map(tuple, own[:, :2].tolist()))
        spans = list(zip(runs[:, 2].tolist(), (last + 1).tolist(), strict=True))
        used = {span: np.unique(a["prim_material"][slice(*span)]).tolist() for span in set(spans)}
        needed = {(each, material) for each, span in set(zip(world, spans, strict=True)) for material in used[span]}
        _require(needed <= set(rows) and rows == sorted(set(rows)) and (own >= 0).all() and (own < 2**31).all()
                 and np.isin(begins, np.append(runs[:, 0], len(geometry))).all(), "has wrong materials of worlds")


def _geometry_of(a: Mapping[str, np.ndarray]) -> InstancedGeometry:
    ends = np.cumsum(np.concatenate([np.zeros((1, 2), np.int64), a["part_sizes"]]), axis=0)
    _require((a["part_sizes"] >= 0).all() and (ends[-1] == (len(a["vertices"]), len(a["faces"]))).all(), "has parts of wrong sizes")
    parts: list[Geometry] = []
    origins = a.get("part_origins")
    _require(origins is None or (len(origins) == len(a["part_sizes"]) and np.isfinite(origins).all()), "has a wrong origin")
    for (vertex, face), (last_vertex, last_face) in pairwise(ends):
        faces = a["faces"][face:last_face] - np.int32(vertex)
        _require(_within(faces, last_vertex - vertex), "has a face beyond its vertices")
        own = None if origins is None or not origins[len(parts)].any() else origins[len(parts)]
        parts.append(Geometry(a["vertices"][vertex:last_vertex], faces, a["spheres"] if not parts else a["spheres"][:0], own))
    part, first, count = a["part"], a["first_prim"], np.array([each.n_triangles for each in parts], np.int64)
    _require(len(parts) > 0 and _within(part, len(parts)) and len(part) == len(first) == len(a["to_world"]), "has a wrong instance")
    n_triangles = int(count[part].sum())
    if "prim_ids" in a:
        numbered = NumberedGeometry(parts[0].vertices, parts[0].faces, parts[0].spheres, prim_ids=a["prim_ids"])
        parts[0] = numbered
        _require(len(numbered.prim_ids) == len(numbered) and (np.diff(numbered.prim_ids) > 0).all()
                 and _within(numbered.prim_ids, n_triangles + len(numbered.spheres)), "has a wrong prim_id")
    ordinary = part > 0 if "prim_ids" in a else np.ones(len(part), bool)
    _require((first >= 0).all() and (first[ordinary] + count[part[ordinary]] <= n_triangles).all() and not first[~ordinary].any(),
             "has a wrong prim_id")
    to_world = a["to_world"].reshape(-1, 3, 4)
    worlds = a.get("worlds")
    _require(worlds is None or (len(worlds) > 1 and worlds[0] == 0 and worlds[-1] == len(part) and (np.diff(worlds) >= 0).all()),
             "has wrong worlds")
    return InstancedGeometry(tuple(parts), part, to_world, first, n_triangles, worlds, a.get("origin"))


def _within(indices: np.ndarray, count: int) -> bool:
    return not len(indices) or bool(indices.min() >= 0 and indices.max() < count)


def _require(sound: object, what: str) -> None:
    if not sound:
        raise InputError(f"is damaged: {what}")
