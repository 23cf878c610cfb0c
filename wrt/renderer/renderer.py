"""Repeated renders of one scene on one device: with other seeds, cameras and settings, and after objects have moved."""

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

REFINED_FROM = 8  # smallest number of camera samples per triangle for which refining the tree saves time


class Renderer:
    """A prepared scene, which `run` renders any number of times. Raises InputError if the scene cannot be rendered.

    once: True if the caller needs one picture only. If this picture has few samples, wrt then chooses a faster builder (`builder_for`)."""

    def __init__(self, scene: Scene, options: Options, *, once: bool = False) -> None:
        if options.executor is not None or options.devices is not None:
            raise InputError("a Renderer runs on one device", hint="use wrt.render for `devices` or `executor`")
        device = start(options.device)
        plan = plan_of(scene, options)
        plan.require_memory(device)
        self.checkpoint = checkpoint_of(plan, kind_of(device))
        if once and (builder := builder_for(plan)):  # the checkpoint does not contain it: a resumed render may use another tree
            plan = replace(plan, options=replace(options, accel_options=builder | options.accel_options))
        self.prepared = prepare(plan, device)

    @property
    def accel(self) -> Accelerator:
        return self.prepared.accel

    def aim(self, camera: CameraKind, angles_of: tuple[int, int] | None = None, **settings: Unpack[SettingChanges]) -> None:
        """Set the camera and settings of the next `run`. Kernels and structure stay. The parameters are those of Prepared.aimed."""
        if self.checkpoint is not None:
            raise InputError("a renderer with a checkpoint cannot change its camera or settings")
        self.prepared = self.prepared.aimed(camera, angles_of, **settings)

    def move_objects(self, scene: Scene, rebuild_at: float) -> dict[str, object]:
        """Replace the scene by a scene with the same objects in other places: upload the surfaces, and refit the structure.

        The structure is rebuilt if it cannot be refitted, or if its SAH cost would grow by more than the factor `rebuild_at`. Returns
        "structure" ("refitted" or "rebuilt"), "seconds", and "growth", the factor by which the SAH cost grew (NaN: unknown)."""
        old = self.prepared
        plan = old.plan.moved(scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)  # the constructor has reported the warnings
            arrays = upload_scene(plan.scene, old.device, plan.meshes)
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
        """Render one picture. seed, spp: replace the options' seed and the scene's spp; None keeps them."""
        if self.checkpoint is not None and (seed is not None or spp is not None):
            raise InputError("a renderer with a checkpoint cannot change its seed or spp")
        return Run(LocalTracer(self.prepared), self.checkpoint, seed, spp).film()


def builder_for(plan: Plan) -> dict[str, str]:
    """Return {"builder": "binned"} if, for a single picture, the default builder takes longer than it saves; else {}."""
    triangles = sum(len(mesh.faces) for mesh in stored_meshes(plan.scene, plan.meshes))
    few = triangles > SMALL and plan.area * plan.scene.settings.spp < REFINED_FROM * triangles
    return {"builder": "binned"} if few and default_options(plan.accel).get("builder") == "refined" else {}


def same_faces(before: Geometry, now: Geometry | InstancedGeometry) -> bool:
    """Return True if only vertex positions differ. A face whose corners become collinear is left out, so that the faces differ."""
    return (isinstance(now, Geometry) and np.array_equal(before.faces, now.faces) and before.vertices.shape == now.vertices.shape)
