"""Rays among the geoms of a MuJoCo model, with wrt's queries: `mj_ray`, `mj_multiRay`, and mujoco-warp's `rays`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from wrt.accel.queries.rays import filled
from wrt.accel.scenes.build import build
from wrt.compat.common import mesh_of, warn_of
from wrt.core.checks import shown
from wrt.core.device import launch_on, start, upload
from wrt.core.errors import InputError
from wrt.core.settings import DEFAULT_DEVICE
from wrt.core.threads import thread_count
from wrt.kernels.shape_rays import Answers, GeomRays, Shapes, place_geoms, spread_rays, write_answers
from wrt.scene import shapes
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

if TYPE_CHECKING:
    import mujoco

    from wrt.core.types import ArrayLike, WarpArray

KINDS = ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")  # by mujoco.mjtGeom
SEGMENTS = 128  # edges of the circles of curved geoms
MOST = 1e10  # mujoco.mjMAXVAL
PLANES = 31  # that fit in masks of 32 bits


def from_mujoco(model: mujoco.MjModel, data: Any = None, *, device: str | None = None, threads: int | None = None,
                **options: Any) -> ModelGeoms:
    """Build a structure over the geoms of a MuJoCo model, which follows its simulation.

    Planes, boxes, meshes and height fields (with walls and base) are exact, but endless planes are squares of 20 km. Spheres, capsules,
    ellipsoids and cylinders are meshes at most 0.0006 of the radius below the surface. SDFs, flexes, skins and planes behind the 31st are
    named in one warning and left out.

    Parameters
    ----------
    model : mujoco.MjModel
        Sizes and meshes are copied; colours and groups are read at each query.
    data : mujoco.MjData or mujoco_warp.Data, optional
        State to follow first; by default the model's own. A Data of mujoco-warp has `nworld` worlds, and its device is the default.
    device, threads, **options
        See `wrt.build`.

    Returns
    -------
    ModelGeoms
        Structure that follows the simulation, with `ray`, `multi_ray` and `rays`.

    Raises
    ------
    InputError
        For other objects, and for models without a geom that can be traced.
    """
    if not any(kind.__name__ == "MjModel" for kind in type(model).__mro__):
        raise InputError(f"must be a mujoco.MjModel, got {shown(model)}", argument="model")
    if data is None:
        import mujoco

        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    if device is None:
        device = str(data.geom_xpos.device) if isinstance(data.geom_xpos, wp.array) else DEFAULT_DEVICE
    return ModelGeoms(model, data, device, thread_count(threads), options)


def _field(model: mujoco.MjModel, index: int) -> Mesh:
    """Return a height field: its surface, the walls below it, and the box of its base, as `mj_ray` sees them."""
    (x, y, top, base), rows, columns = model.hfield_size[index], int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
    heights = top * model.hfield_data[model.hfield_adr[index]:][: rows * columns].astype(np.float64)
    grid = np.stack([*np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows)), heights.reshape(rows, columns)], axis=-1)
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (each.reshape(-1) for each in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]))
    rim = np.concatenate([ids[0, :-1], ids[:-1, -1], ids[-1, :0:-1], ids[:0:-1, 0]])  # seen from above, counter-clockwise
    low = grid.reshape(-1, 3)[rim] * [1.0, 1.0, 0.0]
    i, n = np.arange(len(rim)), rows * columns
    k, after = np.roll(i, -1), np.roll(rim, -1)
    walls = np.concatenate([np.stack([n + i, n + k, after], axis=1), np.stack([n + i, after, rim], axis=1)])
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1), walls])
    surface = Mesh(np.concatenate([grid.reshape(-1, 3), low]), faces)
    return shapes.merged([surface, shapes.box((-x, -y, -base), (x, y, 0.0))], "hfield") if base > 0.0 else surface


def _mesh_of(model: mujoco.MjModel, geom: int) -> Mesh | None:
    """Return the mesh of a geom, in its own space, or None if it cannot be traced."""
    kind, size, data = dict(enumerate(KINDS)).get(int(model.geom_type[geom]), ""), model.geom_size[geom], int(model.geom_dataid[geom])
    if kind == "HFIELD":
        return _field(model, data)
    if kind == "MESH":
        return Mesh(model.mesh_vert[model.mesh_vertadr[data]:][: model.mesh_vertnum[data]],
                    model.mesh_face[model.mesh_faceadr[data]:][: model.mesh_facenum[data]])
    return mesh_of(kind, size * [1.0, 1.0, 0.0] if kind in ("CAPSULE", "CYLINDER") else size, SEGMENTS)


def _meshes(model: mujoco.MjModel) -> dict[int, Mesh]:
    """Return the meshes of geoms, by index; equal geoms share one. What cannot be traced is named in a warning."""
    known: dict[tuple[object, ...], Mesh | None] = {}
    out, left = {}, [f"{count} {what}" for count, what in ((model.nflex, "flexes"), (model.nskin, "skins")) if count]
    planes = np.flatnonzero(model.geom_type == 0)
    for geom in range(model.ngeom):
        key = (int(model.geom_type[geom]), int(model.geom_dataid[geom]), *model.geom_size[geom].tolist())
        if key not in known:
            known[key] = _mesh_of(model, geom)
        if (mesh := known[key]) is None or geom in planes[PLANES:]:
            left.append(f"geom {geom} {model.geom(geom).name!r}")
        else:
            out[geom] = mesh
    warn_of(left)
    if not out:
        raise InputError("has no geom that can be traced", argument="model")
    return out


class ModelGeoms:
    """The geoms of a MuJoCo model, made by `from_mujoco`. `accel` is the structure over the worlds, without the geoms that the last
    call filtered. Its planes have two sides, its `bodies` are `geom_bodyid`, and its `masks` are for `rays`. `geom`, (G,) int32, is the
    model's index of each object of a world (`hits.object`)."""

    def __init__(self, model: mujoco.MjModel, data: Any, device: str, threads: int, options: dict[str, Any]) -> None:
        self.model, self.device, self.threads = model, start(device), threads
        self.worlds = data.nworld if isinstance(data.geom_xpos, wp.array) else 1
        meshes = _meshes(model)
        self.geom, self._hidden, n = np.array(list(meshes), np.int32), np.zeros(len(meshes), bool), self.worlds * len(meshes)
        self._geom_of, self._filter = (upload(each, wp.int32, self.device) for each in (self.geom, self._hidden))
        self._of_prim = np.append(np.repeat(self.geom, [len(mesh.faces) for mesh in meshes.values()]), -1).astype(np.int32)
        self._poses = wp.empty((n, 3, 4), dtype=wp.float32, device=self.device)
        self._read(data)
        self._place()
        poses = np.tile(np.eye(4), (self.worlds, len(meshes), 1, 1))
        poses[..., :3, :] = self._poses.numpy().reshape(self.worlds, len(meshes), 3, 4)
        self.accel: Any = build([Scene(tuple(Object(mesh, transform=pose) for mesh, pose in zip(meshes.values(), each, strict=True)))
                                 for each in poses], device=str(self.device), threads=threads, **options)
        self.accel.move(self._poses)  # the first move in place makes arrays
        plane, first = model.geom_type[self.geom] == 0, (self.accel.geometry.first_instance, self.accel.geometry.first_prim_in_world)
        masks = np.where(plane, 1 << np.cumsum(plane), 1)  # see spread_rays
        for array, values in ((self.accel.bodies, model.geom_bodyid[self.geom]), (self.accel.masks, masks)):
            array.assign(np.tile(values, self.worlds).astype(np.int32))
        self._planes, *shapes_of = (upload(each, wp.int32, self.device) for each in (
            self.geom[plane], np.tile(self.geom, self.worlds), *first))
        self._shapes = filled(Shapes, shapes_of)

    def _launch(self, kernel: Any, n: int, *inputs: object) -> None:
        launch_on(self.device, kernel, n, *inputs, None, threads=self.threads, step=16384, captured=True)

    def _read(self, data: Any) -> None:
        """Keep the poses of a state: Warp arrays as they are, else a copy."""
        arrays, shape = [], (self.worlds, self.model.ngeom)
        for name, size in (("geom_xpos", 3), ("geom_xmat", 9)):
            array = getattr(data, name)
            if not isinstance(array, wp.array):
                array = upload(np.asarray(array, np.float32).reshape(1, -1, size), wp.float32, self.device)
            if array.shape[:2] != shape or array.device != self.device or not array.is_contiguous:
                raise InputError(f"must have {name} of {shape[0]} worlds of {shape[1]} geoms on {self.device}, got {shown(array)}",
                                 argument="data")
            arrays.append((wp.array(ptr=array.ptr, dtype=wp.float32, shape=shape[0] * shape[1] * size, device=self.device), array))
        self._state = arrays

    def _place(self) -> None:
        self._launch(place_geoms, len(self._poses), self._geom_of, self.model.ngeom, self._filter, *(flat for flat, _ in self._state),
                     self._poses)

    def follow(self, data: Any) -> None:
        """Move all geoms to their poses, in place. Rays miss a geom whose pose is NaN (`accel.invalid_moves`).

        Parameters
        ----------
        data : mujoco.MjData or mujoco_warp.Data
            State whose `geom_xpos` and `geom_xmat` are read, after mj_forward or mj_step. Graphs can capture the call with the latter.

        Raises
        ------
        InputError
            For a state with another number of worlds or geoms.
        """
        self._read(data)
        self._place()
        self.accel.move(self._poses)

    def _hide(self, geomgroup: ArrayLike | None, flg_static: bool, hidden: np.ndarray) -> None:
        """Remove these geoms, (ngeom,), those of groups, static ones and those without opacity from the structure; put back the others."""
        m, material = self.model, self.model.geom_matid
        opacity = np.where(material < 0, m.geom_rgba[:, 3], m.mat_rgba[material, 3] if m.nmat else 1.0)
        groups = np.ones(6) if geomgroup is None else np.array([*cast(Any, geomgroup)])
        if groups.shape != (6,):
            raise InputError(f"must have 6 numbers, got {shown(geomgroup)}", argument="geomgroup")
        hidden = (hidden | (opacity == 0.0) | (groups[np.clip(m.geom_group, 0, 5)] == 0)
                  | ((m.body_weldid[m.geom_bodyid] == 0) & (not flg_static)))[self.geom]
        if (hidden != self._hidden).any():
            self._hidden = hidden
            self._filter.assign(hidden.astype(np.int32))
            self._place()
            self.accel.move(self._poses)

    def ray(self, pnt: ArrayLike, vec: ArrayLike, geomgroup: ArrayLike | None = None, flg_static: bool = True, bodyexclude: int = -1,
            geomid: np.ndarray | None = None, normal: np.ndarray | None = None) -> float:
        """Find the closest geom on a ray, as `mj_ray` does after its first two arguments.

        Parameters
        ----------
        pnt, vec, geomgroup, flg_static, bodyexclude, geomid, normal
            See `multi_ray`.

        Returns
        -------
        float
            t of the hit, or -1.
        """
        self.multi_ray(pnt, vec, geomgroup, flg_static, bodyexclude, geomid, dist := np.empty(1), normal, 1)
        return float(dist[0])

    def multi_ray(self, pnt: ArrayLike, vec: ArrayLike, geomgroup: ArrayLike | None, flg_static: bool, bodyexclude: int,
                  geomid: np.ndarray | None, dist: np.ndarray, normal: np.ndarray | None, nray: int, cutoff: float = MOST) -> None:
        """Find the closest geom on rays from one point, as `mj_multiRay` does after its first two arguments, at the last `follow`.

        As in MuJoCo, rays do not see planes from below, nor geoms with an alpha of 0.

        Parameters
        ----------
        pnt, vec : (3,) and (nray * 3,) array_like
            Origin and directions in world space, of any length. Rays with 0 (with which MuJoCo ends the process), NaN or inf miss.
        geomgroup : (6,) array_like, optional
            0 for groups of geoms that rays do not see.
        flg_static : bool
            Whether rays see geoms of bodies that are welded to the world.
        bodyexclude : int
            Body whose geoms rays do not see, or -1.
        geomid, dist, normal : (nray,), (nray,) and (nray * 3,) contiguous NumPy arrays
            Receive indices of geoms, t in units of the direction's length, and outward unit normals; -1, -1 and 0 on a miss.
            `geomid` and `normal` may be None.
        nray : int
            Number of rays.
        cutoff : float
            As in MuJoCo, rays do not see geoms whose bounding sphere is farther from `pnt`; hits on other geoms may be farther.

        Raises
        ------
        InputError
            For other shapes, and for several worlds: use `rays`.
        """
        m, (position, turn) = self.model, (array.numpy().reshape(self.worlds * self.model.ngeom, -1) for _, array in self._state)
        origin, directions = (np.asarray(each, np.float32).reshape(-1) for each in (pnt, vec))
        for name, array, size in (("pnt", origin, 3), ("vec", directions, 3 * nray), ("dist", dist, nray), ("geomid", geomid, nray),
                                  ("normal", normal, 3 * nray)):
            if array is not None and array.size != size:
                raise InputError(f"must have {size} numbers, got {shown(array)}", argument=name)
        if self.worlds != 1:
            raise InputError(f"answers one world, not {self.worlds}", place="multi_ray", hint="use rays")
        below = np.einsum("ij,ij->i", turn[:, 2::3], origin - position) < 0.0
        away = (np.linalg.norm(position - origin, axis=1) > cutoff + m.geom_rbound) & (m.geom_rbound > 0.0)
        self._hide(geomgroup, flg_static, away | (below & (m.geom_type == 0)) | (m.geom_bodyid == bodyexclude))
        rays = (upload(np.broadcast_to(each.reshape(-1, 3), (nray, 3)), wp.vec3, self.device) for each in (origin, directions))
        hits = self.accel.closest_hit(*rays, threads=self.threads)  # of Warp arrays: rays that are not valid miss
        hit, prim_id = (t := hits.t.numpy()) < np.inf, hits.prim_id.numpy()
        dist.reshape(-1)[:] = np.where(hit, t, -1.0)
        if geomid is not None:
            geomid.reshape(-1)[:] = self._of_prim[prim_id]
        if normal is not None:
            normal.reshape(-1, 3)[:] = np.where(hit[:, None], hits.shading_normal.numpy(), 0.0)

    def rays(self, pnt: WarpArray, vec: WarpArray, geomgroup: ArrayLike | None, flg_static: bool, bodyexclude: WarpArray, dist: WarpArray,
             geomid: WarpArray, normal: WarpArray) -> None:
        """Find the closest geom on rays of all worlds, as `mujoco_warp.rays` does after its first two arguments, at the last `follow`.

        Parameters
        ----------
        pnt, vec : (1, N) or (W, N) Warp arrays of vec3
            Origins and directions; with one row, all W worlds have the same.
        geomgroup, flg_static
            See `multi_ray`; a group of -1 is seen.
        bodyexclude : (N,) Warp array of int32
            Body whose geoms the ray does not see, or -1.
        dist, geomid, normal : (W, N) Warp arrays of float32, int32 and vec3
            Receive the answers of `multi_ray`.

        Raises
        ------
        InputError
            For arrays of another shape, type or device.
        """
        n = tuple(getattr(vec, "shape", ()))[-1:]
        every, one = (self.worlds, *n), (1, *n)
        for name, array, kind, forms in (("pnt", pnt, wp.vec3, (one, every)), ("vec", vec, wp.vec3, (one, every)),
                                         ("bodyexclude", bodyexclude, wp.int32, (n,)), ("dist", dist, wp.float32, (every,)),
                                         ("geomid", geomid, wp.int32, (every,)), ("normal", normal, wp.vec3, (every,))):
            if not (isinstance(array, wp.array) and array.is_contiguous and (array.dtype, array.device) == (kind, self.device)
                    and array.shape in forms):
                raise InputError(f"must be a contiguous Warp array {forms[-1]} of {kind.__name__} on {self.device}, got {shown(array)}",
                                 argument=name)
        self._hide(geomgroup, flg_static, np.zeros(self.model.ngeom, bool))
        arrays = [wp.empty(every, dtype=kind, device=self.device) for kind in (wp.vec3, wp.vec3, wp.int32, wp.int32, wp.int32)]
        given = filled(GeomRays, (pnt, vec, bodyexclude.reshape(one)))
        self._launch(spread_rays, dist.size, given, self._planes, self.model.ngeom, self._state[1][0], filled(GeomRays, arrays))
        origin, direction, exclude, mask, world = (each.flatten() for each in arrays)
        hits = self.accel.closest_hit(origin, direction, exclude=exclude, mask=mask, world=world, threads=self.threads)
        found, out = (hits.t, hits.shading_normal, hits.prim_id), (each.flatten() for each in (dist, normal, geomid))
        self._launch(write_answers, dist.size, self._shapes, world, filled(Answers, found), filled(Answers, out))
