"""From the records of a sample (wrt.kernels.loops.record) to its tree of rays."""

import math
from collections import defaultdict
from typing import Any

import numpy as np

from wrt.accel.flat_scene import FlatScene
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.follow_up import CUT_BY_DEPTH, FOLLOWED
from wrt.kernels.shade.paths import COATED, ONWARD, REFLECTED
from wrt.renderer.inspector.tree import AMBIENT, Light, Place, Ray
from wrt.renderer.upload import mesh_lights
from wrt.scene.model import Scene

Row = Any  # an entry of a structured array
NOWHERE = np.full(3, np.nan, np.float32)
BLACK = np.zeros(3, np.float32)


class Assembler:
    """Makes trees, with the names of a scene's shapes, materials and lights. world: the scene as arrays."""

    def __init__(self, scene: Scene, world: FlatScene, features: Features) -> None:
        self.first_prims = np.zeros(0, np.int64) if world.objects is None else world.objects
        self.shapes = [*_names(scene.objects, "object"), *_names(scene.spheres, "sphere")]
        self.materials = _names(scene.materials, "material")
        self.emissive = [material.is_emissive for material in scene.materials]
        self.lights = _names(scene.lights, "light")
        spheres = zip(_names(scene.spheres, "sphere"), scene.spheres, strict=True)
        self.lights += [name for name, sphere in spheres if sphere.material.lights_others]
        for prim_id, _, _ in mesh_lights(scene, world):
            first, last = (self.shape_of(int(each)) for each in (prim_id[0], prim_id[-1]))
            self.lights.append(self.shapes[first] if first == last else "all emissive objects")
        self.lights += ["background"] * features.sky_light + [AMBIENT] * features.ambient_occlusion
        self.material_of = world.materials

    def shape_of(self, prim_id: int) -> int:
        """Return the index of the object or, after all objects, of the sphere that a primitive belongs to."""
        return int(np.searchsorted(self.first_prims, prim_id, side="right")) - 1

    def tree(self, records: dict[str, np.ndarray]) -> Ray | None:
        """Return the camera ray with all rays below it; None without rays.

        The loop takes the new path that it pushed last. The same stack of the recorded paths says which path a traced ray belongs to."""
        ends, paths = records["ends"], records["paths"]
        begun, lights = defaultdict[int, list[int]](list), defaultdict[int, list[Light]](list)
        for at, path in enumerate(paths):
            begun[int(path["end"])].append(at)
        for row in records["lights"]:
            lights[int(row["end"])].append(self._light(row, records["rays"]))
        path_of, end_of, stack = dict[int, int](), dict[int, int](), list[int]()
        for i in range(len(ends)):
            if i:
                path_of[i] = stack.pop()
                end_of[path_of[i]] = i
            stack += [at for at in begun[i] if paths[at]["verdict"] == FOLLOWED]
        rays = dict[int, Ray]()  # by index of their ends; a child's end comes after its parent's
        for i in reversed(range(len(ends))):
            children = tuple(rays.pop(end_of[at]) if at in end_of else self._cut(paths[at]) for at in begun[i])
            kind = _kind(paths[path_of[i]]) if i else "camera"
            rays[i] = self._ray(kind, ends[i], records["rays"][ends[i]["ray"]], tuple(lights[i]), children)
        return rays.get(0)

    def _ray(self, kind: str, end: Row, traced: Row, lights: tuple[Light, ...], children: tuple[Ray, ...]) -> Ray:
        hit = end["material"] >= 0
        here = hit and self.emissive[end["material"]] and bool(end["own"].any())
        ended = "missed" if not hit else "continued" if children else "emission" if here else "absorbed"
        point, normal, shading_normal = (end[name].copy() if hit else NOWHERE for name in ("point", "geometric", "shading"))
        throughput, weight, own, direct, radiance = (end[name].copy() for name in ("throughput", "weight", "own", "direct", "radiance"))
        return Ray(*self._place(traced), kind, int(end["depth"]), throughput, ended, point, normal, shading_normal, bool(end["front"]),
                   weight, own, direct, radiance, lights, children)

    def _cut(self, path: Row) -> Ray:
        """Return a ray that was not traced: it adds nothing."""
        ended = "cut by depth" if path["verdict"] == CUT_BY_DEPTH else "cut by throughput"
        place = (path["origin"].copy(), path["direction"].copy(), 0.0, math.inf, -1, math.nan, -1, "", "")
        return Ray(*place, _kind(path), int(path["depth"]), path["throughput"].copy(), ended, NOWHERE, NOWHERE, NOWHERE, False,
                   BLACK, BLACK, BLACK, BLACK, (), ())

    def _light(self, row: Row, rays: np.ndarray) -> Light:
        first, count, transmittance = int(row["first_ray"]), int(row["n_rays"]), row["transmittance"]
        state = ("dark" if count == 0 else "cut" if row["cut"] else "seen" if (transmittance == 1.0).all()
                 else "dimmed" if transmittance.any() else "blocked")
        parts = tuple(Place(*self._place(each)) for each in rays[first : first + count])
        return Light(self.lights[row["light"]], state, row["value"].copy(), transmittance.copy(), row["value"] * transmittance, parts)

    def _place(self, ray: Row) -> tuple[np.ndarray, np.ndarray, float, float, int, float, int, str, str]:
        prim_id, exclude = int(ray["prim_id"]), int(ray["exclude_plus_one"]) - 1
        shape = self.shapes[self.shape_of(prim_id)] if prim_id >= 0 else ""
        material = self.materials[self.material_of(np.array([prim_id]))[0]] if prim_id >= 0 else ""
        t = float(ray["t"]) if prim_id >= 0 else math.inf
        segment = float(ray["t_min"]), float(ray["t_max"])
        return ray["origin"].copy(), ray["direction"].copy(), *segment, exclude, t, prim_id, shape, material


def _names(things: Any, noun: str) -> list[str]:
    return [thing.name or f"{noun} {i}" for i, thing in enumerate(things)]


def _kind(path: Row) -> str:
    if path["branch"] in (ONWARD, COATED):
        return "onward" if path["branch"] == ONWARD else "coated"
    return "reflected" if path["branch"] == REFLECTED else "refracted" if path["bends"] else "transmitted"
