"""Compare both loops of the renderer on random scenes: `python -m tests.random_scenes --count 10000 --seed 0`.

The scenes of a group share their kernels: the group's number determines everything that selects a kernel, and the scene's seed
everything else. `--only GROUP SEED` repeats a case.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from tests import random_cases
from tests.both_loops import aovs_of, differences, film_of, one_ray_at_a_time, small_waves
from tests.random_fields import Draw, Rng, sketch
from wrt.accel.structures import ACCELERATORS
from wrt.core.device import start
from wrt.core.errors import SceneWarning
from wrt.kernels.units.box import RAY_AABB
from wrt.kernels.units.triangle import RAY_TRIANGLE
from wrt.renderer.options import AOVS, Options
from wrt.renderer.plan import Plan, plan_of
from wrt.renderer.prepare import prepare
from wrt.scene import shapes
from wrt.scene.backgrounds import BACKGROUNDS
from wrt.scene.cameras import CAMERAS
from wrt.scene.lights import LIGHTS
from wrt.scene.materials import MATERIALS, SLOTS, Material
from wrt.scene.mesh import Mesh, unit_rows
from wrt.scene.model import Object, Scene, Sphere, scene_at
from wrt.scene.motion import Motion
from wrt.scene.settings import Settings

ODDS_OF_MATERIAL = {**dict.fromkeys(SLOTS, 0.25), "emission": 0.4, "emits_light": 0.3, "alpha_mode": 0.5, "transmission": 0.4}
DEPTHS = 1, 2, 3, 4, 5, 24  # bounces
MOST_RAYS = 5  # largest max_depth for min_throughput = 0: with more bounces, a sample could have millions of rays
SHAPES: tuple[Callable[[], Mesh], ...] = (
    shapes.quad, shapes.box, shapes.prism, lambda: shapes.icosphere(0), lambda: shapes.icosphere(1),
    lambda: shapes.torus(0.7, 0.3, 7, 5))


@dataclass(frozen=True)
class Placed:
    """An object in every scene of a group."""

    mesh: int  # An index into Group.meshes.
    materials: tuple[int, ...]  # Indices into Group.materials.
    moves: str  # "", "keys" (a moving transform) or "target" (and a morph).
    around: bool  # The object is so large that it encloses the others, and usually the camera.


@dataclass(frozen=True)
class Group:
    """The properties that the scenes of a group share. meshes: (is smooth, has uvs) of each mesh; spheres: material of each sphere."""

    materials: list[Draw]
    meshes: list[tuple[bool, bool]]
    objects: list[Placed]
    spheres: list[int]
    lights: list[Draw]
    camera: Draw
    background: Draw
    settings: Settings
    ambient: bool
    options: dict[str, Any]


def some_of(rng: Rng, names: Any, number: int) -> list[str]:
    """Return the name whose turn it is, so that successive groups cover all names, and a random 40 % of the others."""
    return [name for i, name in enumerate(names) if i == number % len(names) or rng.random() < 0.4]


def is_cut_out(material: Material) -> bool:
    """Return whether a texture's alpha cuts holes: not supported on spheres."""
    return material.alpha_mode == "mask" and material.albedo_texture is not None


@cache
def group_of(number: int) -> Group:
    rng = np.random.default_rng(number)
    materials = [sketch(rng, Material, ODDS_OF_MATERIAL, kind=kind) for kind in some_of(rng, MATERIALS, number)
                 for _ in range(rng.integers(1, 3))]
    of_spheres = [i for i, draw in enumerate(materials) if not is_cut_out(draw(np.random.default_rng(0)))]
    instances, smooth = rng.random(2) < (0.4, 0.6)
    meshes = [(bool(smooth and rng.random() < 0.6), bool(rng.random() < 0.8)) for _ in range(rng.integers(2, 5))]
    placed_meshes = [*range(len(meshes)), *([0, 0] if instances else [])]
    owners: list[list[int]] = [[] for _ in placed_meshes]
    for i in range(max(len(materials), len(owners))):  # so that each material is used, and each object has one
        owners[i % len(owners)].append(i % len(materials))
    ways = ["", "", "keys", "keys" if instances else "target"]
    around = 1 if rng.random() < 0.7 else -1
    objects = [Placed(mesh, tuple(own), str(rng.choice(ways)), i == around)
               for i, (mesh, own) in enumerate(zip(placed_meshes, owners, strict=True))]
    kinds = some_of(rng, LIGHTS, number) if rng.random() < 0.8 else []
    deepest = int(rng.choice(DEPTHS))
    settings = sketch(rng, Settings, {"spp": 0.0, "max_depth": 0.0, "min_throughput": 0.0}, max_depth=deepest)
    accel = str(rng.choice([*ACCELERATORS])) if rng.random() < 0.4 else "bvh"
    rare = rng.random() < 0.15
    return Group(
        materials, meshes, objects,
        rng.choice(of_spheres, rng.integers(1, 4)).tolist() if of_spheres and rng.random() < 0.6 else [],
        [sketch(rng, LIGHTS[kind]) for kind in kinds for _ in range(rng.integers(1, 3))],
        sketch(rng, [*CAMERAS.values()][number % len(CAMERAS)]), sketch(rng, [*BACKGROUNDS.values()][number % len(BACKGROUNDS)]),
        settings(rng), bool(rng.random() < 0.4),
        {"accel": accel, "instancing": "always" if instances else "never", "aov": AOVS if rng.random() < 0.5 else (),
         "triangle": str(rng.choice([*RAY_TRIANGLE])) if rare else "watertight",
         "box": str(rng.choice([*RAY_AABB])) if rare else "conservative"})


def rotation(rng: Rng) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q


def placement(rng: Rng) -> np.ndarray:
    """Return a (4, 4) transform that rotates, scales, often mirrors, and sometimes shears."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(rng) * np.exp(rng.normal(0.4, 0.4, 3 if rng.random() < 0.5 else 1))
    if rng.random() < 0.2:
        matrix[:3, :3] @= np.eye(3) + 0.5 * rng.normal(size=(3, 3))
    matrix[:3, 3] = rng.normal(0.0, 1.0, 3)
    return matrix


def soup(rng: Rng) -> Mesh:
    """Return random triangles that share corners; some have no area, some are duplicates."""
    corners = rng.normal(0.0, 0.8, (rng.integers(3, 12), 3))
    return Mesh(corners, rng.integers(0, len(corners), (rng.integers(1, 20), 3)))


def mesh_of(rng: Rng, smooth: bool, has_uvs: bool) -> Mesh:
    """Return a mesh around the origin with edges of length about 1. Its normals are a ball's, perturbed; 10 % are zero (flat)."""
    mesh = soup(rng) if rng.random() < 0.25 else SHAPES[rng.integers(len(SHAPES))]()
    normals = mesh.vertices + rng.normal(0.0, 0.2, mesh.vertices.shape)
    normals[rng.random(len(normals)) < 0.1] = 0.0
    uvs = rng.normal(0.0, 1.0, (len(mesh.vertices), 2)) if has_uvs else None
    return replace(mesh, normals=unit_rows(normals) if smooth else None, uvs=uvs)


def motion_of(rng: Rng, mesh: Mesh, moves: str) -> Motion | None:
    if not moves:
        return None
    keys = rng.normal(0.0, 0.5, (rng.integers(2, 4), 3, 3))
    keys[:, 1] *= 100.0
    keys[:, 2] = np.exp(keys[:, 2])
    target = replace(mesh, vertices=mesh.vertices + rng.normal(0.0, 0.1, mesh.vertices.shape)) if moves == "target" else None
    return Motion(keys, target)


def object_of(rng: Rng, placed: Placed, mesh: Mesh, materials: list[Material], world: np.ndarray) -> Object:
    own = tuple(materials[i] for i in placed.materials)
    world = world @ np.diag([5.0, 5.0, 5.0, 1.0]) if placed.around else world
    which = rng.integers(0, len(own), len(mesh.faces)) if len(own) > 1 else None
    return Object(mesh, own, world @ placement(rng), which, motion=motion_of(rng, mesh, placed.moves))


def plan_of_scene(number: int, seed: int) -> Plan:
    """Return the plan to render the scene with that seed in group `number`."""
    group, rng = group_of(number), np.random.default_rng((number, seed))
    size, far = (1.0, 0.0) if rng.random() < 0.6 else (10.0 ** rng.uniform(-3.0, 3.0), 100.0)
    world = np.diag([size, size, size, 1.0])
    world[:3, 3] = size * far * rng.normal(size=3)
    materials = [replace(draw(rng), two_sided=bool(rng.random() < 0.5)) for draw in group.materials]
    meshes = [mesh_of(rng, *each) for each in group.meshes]
    objects = tuple(object_of(rng, placed, meshes[placed.mesh], materials, world) for placed in group.objects)
    spheres = tuple(Sphere(world[:3, :3] @ rng.normal(0.0, 1.0, 3) + world[:3, 3], size * rng.uniform(0.2, 1.5), materials[i])
                    for i in group.spheres)
    position = rng.normal(size=3) * rng.choice([0.5, 2.0])
    camera = group.camera(rng)
    pose = type(camera).look_at(*(size * each + world[:3, 3] for each in (position, rng.normal(0.0, 0.3, 3)))).camera_to_world
    scene = Scene(objects, spheres, tuple(draw(rng).moved(world) for draw in group.lights),
                  (replace(camera, camera_to_world=pose),), group.background(rng),
                  rng.uniform(0.1, 1.0, 3) if group.ambient else (0.0, 0.0, 0.0), 1.5 * size * (number % 2), group.settings)
    scene = scene_at(scene.with_settings(size=(int(rng.integers(1, 20)), int(rng.integers(1, 12)))), rng.random())
    plan = plan_of(scene, Options(device="cpu", threads=1, **group.options))
    depth = int(rng.integers(0, group.settings.max_depth + 1, 2).max())
    least = 0.0 if depth <= MOST_RAYS and rng.random() < 0.5 else 10.0 ** rng.uniform(-1.5, -0.3)
    return plan.aimed(plan.camera, max_depth=depth, min_throughput=least)


@dataclass(frozen=True)
class Outcome:
    """differ: names of the arrays whose bits differ; film: the arrays by the loop of one ray at a time."""

    differ: list[str]
    film: dict[str, np.ndarray]


def render(number: int, seed: int) -> Outcome:
    """Render the case with both loops, and compare their films and AOVs."""
    plan, rng = plan_of_scene(number, seed), np.random.default_rng((number, seed, 1))
    same_kernels = plan_of_scene(number, 0).features
    assert plan.features == same_kernels, f"scenes {seed} and 0 of group {number} need different kernels"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # for example of emissive materials that light nothing
        ready = prepare(plan, start("cpu"))
    alone = one_ray_at_a_time(ready)
    width, height = plan.scene.settings.size
    x, y = int(rng.integers(width)), int(rng.integers(height)) if rng.random() < 0.3 else 0
    rectangle = x, y, width - x, height - y
    samples, groups, random_seed = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1 << 32))
    expected = film_of(alone, rectangle, (0, samples), groups=groups, seed=random_seed)
    # Sums that the groups share depend on the order of the launches, so with several groups there is one launch.
    launches = [(0, samples)] if groups > 1 or rng.random() < 0.5 else [(i, 1) for i in range(samples)]
    with small_waves(int(rng.choice([64, 100, 16384]))):
        differ = differences(film_of(ready, rectangle, *launches, groups=groups, seed=random_seed), expected)
        if plan.options.aov:
            differ += differences(aovs_of(ready, rectangle), aovs_of(alone, rectangle))
    return Outcome(differ, expected)


def check(number: int, seed: int) -> str:
    """Return the names of the arrays that differ, "" without any."""
    return ", ".join(render(number, seed).differ)


if __name__ == "__main__":
    random_cases.main(__doc__, check, 200)
