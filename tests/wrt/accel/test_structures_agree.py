"""On real meshes, hits of every structure have the bits of brute force."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import wrt
from tests.data import data_path
from tests.structures import STRUCTURES as ALL
from wrt.accel.geometry import Geometry
from wrt.accel.queries.answers import Hits
from wrt.accel.scenes.build import build
from wrt.core.errors import InputError
from wrt.lab.hard_cases.cases import HARD_CASES, HardCase, generate

SMALL = ["meshes/small/suzanne.obj", "meshes/small/cow.obj", "meshes/small/teapot.obj", "meshes/small/legocar.obj",
         "odd/busted.STL", "odd/ADIS16480.STL", "odd/capsule.obj"]
LARGE = ["meshes/medium/rocker-arm.obj", "meshes/medium/stanford_bunny.ply", "meshes/medium/sponza_dabrovic.obj"]
LARGEST = ["meshes/large/conference_331k.ply", "meshes/large/dragon_871k.ply"]
STRUCTURES = [name for name in ALL if name != "brute_force"]
HARD = ["D_without_area_wide", "D_huge", "D_tiny", "E_grid", "F_slivers", "F_edge_on", "H_exact_ends", "I_underflow", "I_denormal",
        "I_tiny_components"]
TESTS = 60_000_000  # ray-triangle tests that brute force may take in the quick run


def mixed_rays(mesh: wrt.Mesh, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rays into the mesh, from inside in all directions, towards vertices, and along the axes at coordinates of vertices."""
    rng = np.random.default_rng(seed)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    outside = rng.normal(size=(n, 3))
    outside = (low + high) / 2 + outside / np.linalg.norm(outside, axis=1, keepdims=True) * np.linalg.norm(high - low)
    inside = low + rng.random((n, 3)) * (high - low)
    corner = mesh.vertices[rng.integers(len(mesh.vertices), size=n)]
    kind = np.arange(n) % 4
    origins = np.where((kind == 1)[:, None], inside, outside)
    directions = np.where((kind == 2)[:, None], corner, low + rng.random((n, 3)) * (high - low)) - origins
    axis = np.arange(n) % 3
    along = np.zeros((n, 3))
    along[np.arange(n), axis] = rng.choice([-1.0, 1.0], size=n)
    aligned = corner - along * np.linalg.norm(high - low)
    origins = np.where((kind == 3)[:, None], aligned, origins).astype(np.float32)
    directions = np.where((kind == 3)[:, None], along, directions).astype(np.float32)
    return origins, directions


@cache
def expected(name: str, n: int) -> tuple[wrt.Mesh, np.ndarray, np.ndarray, Hits]:
    mesh = wrt.load_mesh(data_path(name))
    origins, directions = mixed_rays(mesh, n, seed=n)
    return mesh, origins, directions, build(mesh, "brute_force").closest_hit(origins, directions)


def check(structure: str, name: str, n: int) -> None:
    mesh, origins, directions, truth = expected(name, n)
    accel = build(mesh, structure)
    hits = accel.closest_hit(origins, directions)
    assert 0.05 < (truth.prim_id >= 0).mean() < 1.0  # enough rays hit, and some miss
    for field in ("prim_id", "t", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(truth, field), err_msg=f"{field} of {name}")
    np.testing.assert_array_equal(accel.any_hit(origins, directions), truth.prim_id >= 0)


@pytest.mark.parametrize("name", SMALL + LARGE)
@pytest.mark.parametrize("structure", STRUCTURES)
def test_same_hits_as_brute_force(structure: str, name: str) -> None:
    triangles = len(wrt.load_mesh(data_path(name)).faces)
    check(structure, name, min(100_000, TESTS // triangles))


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL + LARGE + LARGEST)
@pytest.mark.parametrize("structure", [name for name in STRUCTURES if name != "bvh2"])
def test_same_hits_as_the_bvh_on_a_million_rays(structure: str, name: str) -> None:
    mesh = wrt.load_mesh(data_path(name))
    bvh = build(mesh, "bvh2")
    try:
        accel = build(mesh, structure)
    except InputError as error:
        pytest.skip(str(error))  # a BSP tree has a limit on size
    for seed in range(10):
        origins, directions = mixed_rays(mesh, 100_000, seed)
        truth, hits = bvh.closest_hit(origins, directions), accel.closest_hit(origins, directions)
        for field in ("prim_id", "t", "u", "v"):
            np.testing.assert_array_equal(getattr(hits, field), getattr(truth, field), err_msg=f"{field} of {name}")
        np.testing.assert_array_equal(accel.any_hit(origins, directions), truth.prim_id >= 0)


@cache
def expected_of_case(name: str, n: int) -> tuple[HardCase, Hits]:
    case = generate(name, n, seed=5)
    structure = "brute_force" if n * len(case.geometry.faces) <= TESTS else "bvh2"
    return case, build(geometry_of(case), structure).closest_hit(case.origins, case.directions, case.t_min, case.t_max)


def geometry_of(case: HardCase) -> Geometry:
    return case.geometry if isinstance(case.geometry, Geometry) else Geometry.of(case.geometry)


def check_case(structure: str, name: str, n: int) -> None:
    case, truth = expected_of_case(name, n)
    hits = build(geometry_of(case), structure).closest_hit(case.origins, case.directions, case.t_min, case.t_max)
    for field in ("prim_id", "t", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(truth, field), err_msg=f"{field} of {name}")


@pytest.mark.parametrize("structure", STRUCTURES)
def test_same_hits_on_hard_cases(structure: str) -> None:
    for name in HARD:
        check_case(structure, name, 1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in HARD_CASES if "not_finite" not in name])
@pytest.mark.parametrize("structure", STRUCTURES)
def test_same_hits_on_every_hard_case(structure: str, name: str) -> None:
    # All triangles of the fan share its vertex.
    check_case(structure, name, 1000 if name == "G_fan_vertices" else 20_000)
