"""Meshes of a TOML scene file, from mesh files or formulas, with their materials, transforms and motion."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from wrt.core.checks import unknown
from wrt.core.errors import InputError, at
from wrt.core.types import JsonObject
from wrt.io.mesh_file import load_mesh
from wrt.scene import shapes
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh, smooth
from wrt.scene.model import Object
from wrt.scene.motion import Motion

STILL = {"translate": (0.0, 0.0, 0.0), "rotate": (0.0, 0.0, 0.0), "scale": (1.0, 1.0, 1.0)}


class Meshes:
    """Cache of the meshes of [[meshes]]. Names of files are relative to `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._meshes: dict[tuple[object, ...], Mesh] = {}

    def objects(self, table: JsonObject, place: str, materials: Mapping[str, Material]) -> list[Object]:
        """Return an object for each instance; [] if a material is unknown, which unknown_materials reports."""
        parts = table.get("parts", [])
        mesh = self._smoothed(table, tuple((part["first"], part["count"]) for part in parts), table.get("smooth"))
        by_group: Mapping[str, str] = table.get("materials") or {str(i): part["material"] for i, part in enumerate(parts)}
        groups = set(mesh.groups)
        for group in by_group:
            if group not in groups:
                raise unknown(group, "group of " + mesh.name, mesh.groups, place="materials")
        rest = table.get("material")
        used = np.unique(mesh.face_group).tolist() if mesh.face_group is not None else []
        used_names = [by_group.get(mesh.groups[group], rest) for group in used] if by_group else [rest]
        for group, name in zip(used, used_names, strict=False):
            if name is None:
                raise InputError(f"the triangles of group {mesh.groups[group]!r} have no material", hint="give `material` for the rest")
        names = list(dict.fromkeys(str(name) for name in used_names))
        if not materials.keys() >= set(names):
            return []
        face_material = None
        if by_group and mesh.face_group is not None:
            of_group = np.zeros(len(mesh.groups), dtype=np.int32)
            index = {name: i for i, name in enumerate(names)}
            of_group[used] = [index[str(name)] for name in used_names]
            face_material = of_group[mesh.face_group]
        to_world = transform(table.get("transform"))
        placements = [] if "instances" in table else [to_world]
        for i, instance in enumerate(table.get("instances", [])):
            with at(f"instances[{i}]"):
                placements.append(to_world @ transform(instance))
        used_materials, motion = tuple(materials[name] for name in names), self._motion(table)
        return [Object(mesh, used_materials, matrix, face_material, table.get("name") or place, motion) for matrix in placements]

    def _motion(self, table: JsonObject) -> Motion | None:
        if "motion" not in table and "morph" not in table:
            return None
        keys = [[np.broadcast_to(value, 3) for value in (STILL | key).values()] for key in table.get("motion", [])]
        target = self._smoothed(table["morph"], (), table.get("smooth")) if "morph" in table else None
        return Motion(np.array(keys, np.float64) if keys else None, target)

    def _smoothed(self, table: JsonObject, parts: tuple[tuple[int, int], ...], normals: bool | None) -> Mesh:
        """Return the mesh of the table's file or shape. normals: True adds missing vertex normals, False drops them, None does neither."""
        if "shape" in table:
            arguments = dict(table["shape"])
            make = shapes.SHAPES[arguments.pop("kind")]
            key: tuple[object, ...] = (json.dumps(table["shape"], sort_keys=True),)
            plain = self._once(key, lambda: make(**arguments))
        else:
            path = self._folder / table["file"]
            key = (path, parts)
            plain = self._once(key, lambda: load_mesh(path, parts))
        if normals is None:
            return plain
        return self._once((*key, normals), lambda: smooth(plain) if normals else replace(plain, normals=None))

    def _once(self, key: tuple[object, ...], make: Callable[[], Mesh]) -> Mesh:
        if key not in self._meshes:
            self._meshes[key] = make()
        return self._meshes[key]


def transform(table: JsonObject | None) -> np.ndarray:
    """Return the matrix (4, 4) float64 of a table: scale, then rotate, then translate. None gives the identity.

    Raises InputError for a singular matrix."""
    matrix = np.eye(4)
    if table is None:
        return matrix
    if "matrix" in table:
        matrix = np.array(table["matrix"], np.float64).reshape(4, 4)
        if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            raise InputError("the transform's matrix must be invertible")
        return matrix
    placed: JsonObject = STILL | table
    if "axis" in placed:
        rotation = _about(np.array(placed["axis"], np.float64), placed["angle"])
    else:
        x, y, z = (_about(axis, angle) for axis, angle in zip(np.eye(3), placed["rotate"], strict=True))
        rotation = z @ y @ x
    matrix[:3, :3] = rotation * placed["scale"]
    matrix[:3, 3] = placed["translate"]
    return matrix


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Return the (3, 3) matrix of a rotation about an axis (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cosine, sine = cosine_sine(degrees)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * cross + (1.0 - cosine) * (cross @ cross)


def cosine_sine(degrees: float) -> tuple[float, float]:
    """Return cosine and sine of an angle. Multiples of 90 degrees are exact, so that axis-parallel edges stay axis-parallel."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarters) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
