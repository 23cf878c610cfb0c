"""Meshes of a TOML scene file, from mesh files or formulas, with their materials, transforms and motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.checks import unknown
from wrt.core.errors import InputError, at
from wrt.io.mesh_file import load_mesh
from wrt.io.toml.transforms import transform
from wrt.scene import shapes
from wrt.scene.materials import Material
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object
from wrt.scene.motion import Motion
from wrt.scene.vertex_normals import smooth

if TYPE_CHECKING:
    from wrt.io.toml.schema import MeshTable, MorphTable


class Meshes:
    """Cache of the meshes of [[meshes]]. Names of files are relative to `folder`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._meshes: dict[tuple[object, ...], Mesh] = {}

    def objects(self, table: MeshTable, place: str, materials: Mapping[str, Material]) -> list[Object]:
        """Return an object for each instance; [] if a material is unknown, which unknown_materials reports."""
        parts = table.parts or []
        mesh = self._smoothed(table, tuple((part.first, part.count) for part in parts), table.smooth)
        by_group: Mapping[str, str] = table.materials or {str(i): part.material for i, part in enumerate(parts)}
        groups = set(mesh.groups)
        for group in by_group:
            if group not in groups:
                raise unknown(group, "group of " + mesh.name, mesh.groups, place="materials")
        used = np.unique(mesh.face_group).tolist() if mesh.face_group is not None else []
        used_names = [by_group.get(mesh.groups[group], table.material) for group in used] if by_group else [table.material]
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
        to_world = transform(table.transform)
        placements = [] if table.instances else [to_world]
        for i, instance in enumerate(table.instances or ()):
            with at(f"instances[{i}]"):
                placements.append(to_world @ transform(instance))
        used_materials, motion = tuple(materials[name] for name in names), self._motion(table)
        return [Object(mesh, used_materials, matrix, face_material, table.name or place, motion) for matrix in placements]

    def _motion(self, table: MeshTable) -> Motion | None:
        if table.motion is None and table.morph is None:
            return None
        keys = None if table.motion is None else np.array([[key.translate, key.rotate, key.scale] for key in table.motion])
        return Motion(keys, None if table.morph is None else self._smoothed(table.morph, (), table.smooth))

    def _smoothed(self, table: MeshTable | MorphTable, parts: tuple[tuple[int, int], ...], normals: bool | None) -> Mesh:
        """Return the mesh of the table's file or shape. normals: True adds missing vertex normals, False drops them, None does neither."""
        shape = table.shape
        if shape is not None:
            key: tuple[object, ...] = (shape.model_dump_json(),)
            plain = self._once(key, lambda: shapes.SHAPES[shape.kind](**shape.given("kind")))
        else:
            path = self._folder / str(table.file)
            key = (path, parts)
            plain = self._once(key, lambda: load_mesh(path, parts))
        if normals is None:
            return plain
        return self._once((*key, normals), lambda: smooth(plain) if normals else replace(plain, normals=None))

    def _once(self, key: tuple[object, ...], make: Callable[[], Mesh]) -> Mesh:
        if key not in self._meshes:
            self._meshes[key] = make()
        return self._meshes[key]
