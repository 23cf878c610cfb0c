"""Rays among the shapes of a newton.Model, with wrt's queries: Newton's `intersect_ray`."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from wrt.accel.queries.rays import filled
from wrt.accel.scenes.build import build
from wrt.compat.common import mesh_of, warn_of
from wrt.core.arrays import to_numpy
from wrt.core.checks import as_integer, shown
from wrt.core.device import launch_on, upload
from wrt.core.errors import InputError
from wrt.core.threads import thread_count
from wrt.io.gltf.meshes import compose
from wrt.kernels.shape_rays import Answers, Shapes, known_worlds, place_shapes, write_answers
from wrt.scene.mesh import Mesh
from wrt.scene.model import Object, Scene

if TYPE_CHECKING:
    import newton

    from wrt.core.types import WarpArray

NEEDED = ("shape_type", "shape_flags", "shape_body", "shape_world", "shape_scale", "shape_transform", "shape_source", "shape_label",
          "shape_source_ptr", "shape_opacity", "heightfield_meshes", "world_count", "body_q", "body_count", "device")  # fields of a Model
RAYS = {"ray_origins": wp.vec3, "ray_directions": wp.vec3, "ray_worlds": wp.int32}
RESULTS = {"out_dist": wp.float32, "out_normal": wp.vec3, "out_shape_id": wp.int32}  # in the order of kernels.shape_rays.Answers


def from_newton(model: newton.Model, *, shape_flags: int = 1, segments: int = 128, **options: Any) -> ModelScene:
    """Build a structure over the shapes of all worlds of a Newton Model (1.8), on the model's device.

    Boxes, planes, meshes, convex meshes and height fields are exact, but endless planes are squares of 20 km. Spheres, capsules, cylinders,
    cones and ellipsoids are meshes at most 0.0006 of the radius below the surface (128 segments), a quarter of that with twice as many.
    All surfaces are hit from both sides. Gaussians, particles and deformable surfaces are named in one warning and left out.

    Parameters
    ----------
    model : newton.Model
        Scales and meshes are copied; `follow` reads `shape_transform` and `shape_body` again. The tree is built for its `body_q`.
    shape_flags : int
        Mask of newton.ShapeFlags, as of `Model.bvh_build_shapes`: by default VISIBLE. A shape with opacity 0 is not visible.
    segments, **options
        Edges of the circles of curved shapes, 8 to 4096. Others: see `wrt.build`.

    Raises
    ------
    InputError
        For other objects, a Model of another version, and a model without a shape that can be traced.
    """
    version = getattr(sys.modules.get("newton"), "__version__", None)
    if version is None or not any(kind.__name__ == "Model" for kind in type(model).__mro__):
        raise InputError(f"must be a newton.Model, got {shown(model)}", argument="model", hint="builder.finalize() makes one")
    if missing := [name for name in NEEDED if not hasattr(model, name)]:
        raise InputError(f"is a Model of newton {version} without {missing[0]}; wrt reads those of newton 1.8", argument="model")
    flags, opaque = model.shape_flags.numpy(), 1 if model.shape_opacity is None else model.shape_opacity.numpy() > 0.0
    chosen = np.flatnonzero(np.where(opaque, flags, flags & ~1) & as_integer(shape_flags, "shape_flags", 0, 2**31 - 1))
    meshes = _meshes(model, chosen.tolist(), as_integer(segments, "segments", 8, 4096))
    if not meshes:
        raise InputError("has no shape that can be traced", argument="model", hint="shape_flags selects the shapes")
    return ModelScene(model, meshes, options)


def _mesh_of(kind: str, size: np.ndarray, source: Any, segments: int) -> Mesh | None:
    """Return the mesh of a shape with a kind of newton.GeoType, or None if it cannot be traced."""
    if kind in ("MESH", "CONVEX_MESH", "HFIELD") and source is not None:
        vertices, faces = to_numpy(source.points if kind == "HFIELD" else source.vertices), to_numpy(source.indices).reshape(-1, 3)
        return Mesh(vertices * size, faces[:, ::-1] if np.prod(size) < 0.0 else faces)  # the outside stays outside
    return mesh_of(kind, 0.5 * size if kind == "PLANE" else size, segments)


def _meshes(model: newton.Model, chosen: list[int], segments: int) -> dict[int, Mesh]:
    """Return the meshes of shapes, by index; equal shapes share one. What cannot be traced is named in a warning."""
    from newton import GeoType

    fields, left, known = {mesh.id: mesh for mesh in model.heightfield_meshes}, [], cast(dict[object, Mesh | None], {})
    kinds, sizes, address = (array.numpy() for array in (model.shape_type, model.shape_scale, model.shape_source_ptr))
    for shape in chosen:
        kind, size = GeoType(kinds[shape]).name, sizes[shape].astype(np.float64)
        source = fields.get(address[shape]) if kind == "HFIELD" else model.shape_source[shape]
        key = kind, id(source), *size
        if key not in known:
            with suppress(InputError):  # such as a radius of 0
                known[key] = _mesh_of(kind, size, source, segments) if np.isfinite(size).all() else None
        known[shape] = known.setdefault(key, None)
        left += [f"shape {shape} {model.shape_label[shape]!r} ({kind})"] if known[shape] is None else []
    for name, what in (("particle_count", "particles"), ("tri_count", "deformable triangles")):
        left += [f"{count} {what}"] if (count := getattr(model, name, 0)) else []
    warn_of(left)
    return {shape: mesh for shape in chosen if (mesh := known[shape]) is not None}


class ModelScene:
    """The shapes of a Newton Model, made by `from_newton`. `accel` is the structure over its worlds; a last world has the shapes of world
    -1, which all worlds share. `shape`, (I,) int32, is the index of the model's shape for each value of `hits.instance`."""

    def __init__(self, model: newton.Model, meshes: dict[int, Mesh], options: dict[str, Any]) -> None:
        self.model, self.device = model, model.device
        seen, world = np.array(list(meshes)), model.shape_world.numpy()
        rows = [seen[(world[seen] == each) | (world[seen] < 0)] for each in range(model.world_count)] + [seen[world[seen] < 0]]
        self.shape = np.concatenate(rows).astype(np.int32)
        self._shapes = filled(Shapes, [upload(self.shape, wp.int32, self.device)])
        self._poses = wp.empty(len(self.shape), dtype=wp.transformf, device=self.device)
        self._place(model)
        place = iter(compose((at := self._poses.numpy().astype(np.float64))[:, :3], at[:, 3:], np.ones((len(at), 3))))
        self.accel = build([Scene(tuple(Object(meshes[shape], transform=next(place)) for shape in each.tolist())) for each in rows],
                           device=str(self.device), **options)
        first = self.accel.geometry.first_instance, self.accel.geometry.first_prim_in_world
        self._shapes.first_instance, self._shapes.first_prim = (upload(each, wp.int32, self.device) for each in first)
        self.accel.move(self._poses)  # the first move in place makes arrays
        self.accel.bodies.assign(model.shape_body.numpy()[self.shape])

    def _launch(self, kernel: Any, n: int, *inputs: object) -> None:
        launch_on(self.device, kernel, n, *inputs, None, threads=thread_count(None), step=16384, captured=True)

    def _place(self, state: Any) -> None:
        count = self.model.body_count
        given = getattr(state, "body_q", None) if count else wp.empty(0, dtype=wp.transformf, device=self.device)
        (bodies,) = self._checked((count,), {"body_q": wp.transformf}, {"body_q": given})
        self._launch(place_shapes, len(self.shape), self._shapes, self.model.shape_body, self.model.shape_transform, bodies, self._poses)

    def follow(self, state: Any) -> None:
        """Move all shapes to the poses of bodies, in place. Rays miss a shape whose pose is NaN (`accel.invalid_moves`).

        Parameters
        ----------
        state : newton.State
            State of this model; its `body_q` is read. InputError if it is not one row per body, on the model's device.
        """
        self._place(state)
        self.accel.move(self._poses)

    def _checked(self, shape: tuple[int, ...], kinds: dict[str, Any], given: dict[str, Any]) -> list[WarpArray | None]:
        """Return the given arrays in the order of `kinds`, the types by name, with None for each missing one.
        Raises InputError for other names, and for what is no contiguous Warp array of this type and shape on the device."""
        for name, array in given.items():
            if name not in kinds:
                raise InputError(f"must be one of {', '.join(kinds)}: wrt has no other answers", argument=name)
            if not (isinstance(array, wp.array) and array.is_contiguous
                    and (array.dtype, array.shape, array.device) == (kinds[name], shape, self.device)):
                form = f"{shape} of {kinds[name].__name__} on {self.device}"
                raise InputError(f"must be a contiguous Warp array {form}, got {shown(array)}", argument=name)
        return [given.get(name) for name in kinds]

    def intersect_ray(self, *, ray_origins: WarpArray, ray_directions: WarpArray, ray_worlds: WarpArray, enable_global_world: bool = True,
                      fast_math: bool = True, **out: WarpArray | None) -> None:
        """Find the closest shape on each ray, as `newton.intersect_ray` does, for the state of the last `follow`.

        Parameters
        ----------
        ray_origins, ray_directions : (N,) Warp arrays of vec3
            Rays in world space. Directions have any length but 0; those of 0 or NaN miss.
        ray_worlds : (N,) Warp array of int32
            World of each ray, which also sees the shapes of world -1. A ray of world -1 sees these alone, one of no world nothing.
        enable_global_world, fast_math : bool
            The first must be True, because world -1 is part of every world. The second has no effect: hits are those of `closest_hit`.
        **out
            Warp arrays (N,) to fill: `out_dist` of float32, t in units of the direction's length; `out_shape_id` of int32; `out_normal` of
            vec3, unit normals in world space, outwards, interpolated on curved shapes. A miss has -1, -1 and 0.
        """
        if not enable_global_world:
            raise InputError("must be True: world -1 is part of every world", argument="enable_global_world")
        shape = tuple(getattr(ray_origins, "shape", ()))[:1]
        rays = self._checked(shape, RAYS, dict(zip(RAYS, (ray_origins, ray_directions, ray_worlds), strict=True)))
        wanted = self._checked(shape, RESULTS, {name: array for name, array in out.items() if array is not None})
        world = wp.empty(shape, dtype=wp.int32, device=self.device)
        self._launch(known_worlds, len(world), rays[2], self.model.world_count, world)
        hits: Any = self.accel.closest_hit(cast(Any, rays[0]), rays[1], world=world)
        found = hits.t, None if wanted[1] is None else hits.shading_normal, hits.prim_id
        self._launch(write_answers, len(world), self._shapes, world, filled(Answers, found), filled(Answers, wanted))
