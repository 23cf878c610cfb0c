"""Repeated renders of one scene on one device: with other seeds, cameras and settings, and after objects have moved."""

from __future__ import annotations

import warnings
from dataclasses import asdict, replace
from typing import Any, Unpack

import numpy as np

from wrt.accel.base import OneMesh
from wrt.accel.bvh.small import SMALL
from wrt.accel.geometry import Geometry
from wrt.accel.instanced_geometry import InstancedGeometry
from wrt.accel.queries.accelerator import Accelerator
from wrt.accel.scenes.build import build
from wrt.accel.scenes.instancing import stored_meshes
from wrt.accel.structure import default_options
from wrt.core.device import start
from wrt.core.errors import InputError, SceneWarning
from wrt.picture.film import Film
from wrt.renderer.checkpoint import checkpoint_of
from wrt.renderer.options import Options
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.prepare import kind_of, prepare
from wrt.renderer.schedule import LocalTracer, Run
from wrt.renderer.upload import upload_scene
from wrt.scene.cameras import CameraKind
from wrt.scene.model import Scene
from wrt.scene.settings import SettingChanges

REFINED_FROM = 8  # camera samples per triangle: with fewer, refining the tree costs more time than it saves


class Renderer:
    """A prepared scene, which `run` renders. once: for a single picture. Raises InputError if the scene cannot be rendered."""

    def __init__(self, scene: Scene, options: Options, *, once: bool = False) -> None:
        if options.executor is not None or options.devices is not None:
            raise InputError("an executor or several devices are for wrt.render; this runs on one device")
        device = start(options.device)
        plan = plan_of(scene, options)
        plan.require_memory(device)
        self.checkpoint = checkpoint_of(plan, kind_of(device))
        if once and (builder := builder_for(plan)):  # not in the checkpoint: a resumed render may use another tree
            plan = replace(plan, options=replace(options, accel_options=builder | options.accel_options))
        self.prepared = prepare(plan, device)

    @property
    def accel(self) -> Accelerator:
        return self.prepared.accel

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Unpack[SettingChanges]) -> None:
        """Set the camera and settings of the next `run`, with the same kernels and structure, as Prepared.aimed allows."""
        if self.checkpoint is not None:
            raise InputError("this renderer was not made for a checkpoint")
        self.prepared = self.prepared.aimed(camera, angles_of, **settings)

    def follow(self, scene: Scene, rebuild_at: float) -> dict[str, object]:
        """Replace the scene by one with the same objects, moved: upload its surfaces, and refit the structure.

        The structure is rebuilt if it cannot be refitted, or if its SAH cost would grow by `rebuild_at` or more. Returns "structure"
        ("refitted" or "rebuilt"), "seconds", and "growth" of the SAH cost (NaN: unknown).
        """
        old = self.prepared
        plan = old.plan.moved(scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)  # reported by the constructor
            arrays = upload_scene(scene, old.device, plan.meshes)
        geometry: Any = arrays.world.geometry
        self.prepared = replace(old, plan=plan, arrays=arrays)
        if isinstance(old.accel, OneMesh) and old.accel.can_refit and same_faces(old.accel.geometry, geometry):
            refit = asdict(old.accel.refit(geometry.vertices, rebuild_at))
            return {"structure": "rebuilt" if refit["rebuilt"] else "refitted", "seconds": refit["seconds"], "growth": refit["growth"]}
        options = plan.options
        chosen: dict[str, Any] = {"triangle": options.triangle, "box": options.box, **options.accel_options}
        accel = build(geometry, plan.accel, options.device, old.threads, **chosen)
        self.prepared = replace(self.prepared, accel=accel)
        return {"structure": "rebuilt", "seconds": accel.stats.build_seconds, "growth": float("nan")}

    def run(self, *, seed: int | None = None, spp: int | None = None) -> Film:
        """Render until samples, time limit or target error end it. seed, spp: replace those of options and scene, without a checkpoint."""
        if self.checkpoint is not None and (seed is not None or spp is not None):
            raise InputError("a render with a checkpoint has the seed and spp that it was made with")
        return Run(LocalTracer(self.prepared), self.checkpoint, seed, spp).film()


def builder_for(plan: Plan) -> dict[str, str]:
    """Return the structure's option `builder` for a single picture; empty if its default pays off for the number of samples."""
    triangles = sum(len(mesh.faces) for mesh in stored_meshes(plan.scene, plan.meshes))
    few = triangles > SMALL and plan.area * plan.scene.settings.spp < REFINED_FROM * triangles
    return {"builder": "binned"} if few and default_options(plan.accel).get("builder") == "refined" else {}


def same_faces(before: Geometry, now: Geometry | InstancedGeometry) -> bool:
    """Return True if only vertices differ. Rounding may have made a face collinear, which changes the faces."""
    return (isinstance(now, Geometry) and np.array_equal(before.faces, now.faces) and before.vertices.shape == now.vertices.shape)
