"""From the records of a sample (wrt.kernels.loops.record) to its tree of rays."""

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from wrt.accel.flat_scene import FlatScene
from wrt.kernels.shade.features import Features
from wrt.kernels.shade.follow_up import CUT_BY_DEPTH, FOLLOWED, NONE
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
        ends, traced, lights = records["ends"], records["rays"], defaultdict[int, list[Light]](list)
        for row in records["lights"]:
            lights[int(row["end"])].append(self._light(row, traced))
        begun = [_new_paths(end) if _hit(traced[end["ray"]]) else [] for end in ends]
        path_of, end_of, stack = dict[int, NewPath](), dict[NewPath, int](), list[NewPath]()
        for i in range(len(ends)):
            if i:
                path_of[i] = stack.pop()
                end_of[path_of[i]] = i
            stack += [path for path in begun[i] if path.verdict == FOLLOWED]
        rays = dict[int, Ray]()  # by index of their ends; a child's end comes after its parent's
        for i in reversed(range(len(ends))):
            children = tuple(rays.pop(end_of[path]) if path in end_of else self._cut(path) for path in begun[i])
            rays[i] = self._ray(path_of[i].kind if i else "camera", ends[i], traced[ends[i]["ray"]], tuple(lights[i]), children)
        return rays.get(0)

    def _ray(self, kind: str, end: Row, traced: Row, lights: tuple[Light, ...], children: tuple[Ray, ...]) -> Ray:
        path, surface, light, hit = end["path"], end["surface"], end["next"]["pending_light"], _hit(traced)
        throughput, direct = path["throughput"].copy(), end["direct"]["radiance"].copy()
        weight, own = (light["throughput"].copy(), light["light"].copy()) if hit else (throughput.copy(), end["background"].copy())
        here = hit and self.emissive[surface["material"]] and bool(own.any())
        ended = "missed" if not hit else "continued" if children else "emission" if here else "absorbed"
        point, normal, shading_normal = (surface[name].copy() if hit else NOWHERE for name in ("point", "geometric", "shading"))
        return Ray(*self._place(traced), kind, int(path["depth"]), throughput, ended, point, normal, shading_normal,
                   hit and bool(surface["front"]), weight, own, direct, weight * (own + direct), lights, children)

    def _cut(self, new: "NewPath") -> Ray:
        """Return a ray that was not traced: it adds nothing."""
        ended, path = "cut by depth" if new.verdict == CUT_BY_DEPTH else "cut by throughput", new.path
        place = (path["origin"].copy(), path["direction"].copy(), 0.0, math.inf, -1, math.nan, -1, "", "")
        return Ray(*place, new.kind, int(path["depth"]), path["throughput"].copy(), ended, NOWHERE, NOWHERE, NOWHERE, False,
                   BLACK, BLACK, BLACK, BLACK, (), ())

    def _light(self, row: Row, rays: np.ndarray) -> Light:
        value, shadow, first = row["request"]["value"].copy(), row["shadow"], int(row["first_ray"])
        count, transmittance = int(shadow["rays"]), shadow["transmittance"].copy()
        state = ("dark" if count == 0 else "cut" if shadow["cut"] else "seen" if (transmittance == 1.0).all()
                 else "dimmed" if transmittance.any() else "blocked")
        parts = tuple(Place(*self._place(each)) for each in rays[first : first + count])
        return Light(self.lights[row["light"]], state, value, transmittance, value * transmittance, parts)

    def _place(self, ray: Row) -> tuple[np.ndarray, np.ndarray, float, float, int, float, int, str, str]:
        ray, hit = ray["ray"], ray["hit"]
        prim_id, exclude = int(hit["prim_id"]), int(ray["exclude_plus_one"]) - 1
        shape = self.shapes[self.shape_of(prim_id)] if prim_id >= 0 else ""
        material = self.materials[self.material_of(np.array([prim_id]))[0]] if prim_id >= 0 else ""
        t = float(hit["t"]) if prim_id >= 0 else math.inf
        segment = float(ray["t_min"]), float(ray["t_max"])
        return ray["origin"].copy(), ray["direction"].copy(), *segment, exclude, t, prim_id, shape, material


def _names(things: Any, noun: str) -> list[str]:
    return [thing.name or f"{noun} {i}" for i, thing in enumerate(things)]


def _hit(traced: Row) -> bool:
    return bool(traced["hit"]["prim_id"] >= 0)


@dataclass(frozen=True, eq=False)
class NewPath:
    """A path that begins at a surface."""

    kind: str
    verdict: int
    path: Row


def _new_paths(end: Row) -> list[NewPath]:
    """Return the new paths of a surface, in the order in which the loop pushes them on its stack."""
    shaded, verdicts = end["shaded"], end["next"]
    refracted = "refracted" if shaded["scatter"]["bends"] else "transmitted"
    kinds = {"onward": "onward", "coated": "coated", "reflected": "reflected", "refracted": refracted}
    return [NewPath(kind, int(verdicts[name]), shaded[name]) for name, kind in kinds.items() if verdicts[name] != NONE]
