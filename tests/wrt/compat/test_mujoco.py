"""wrt.compat.mujoco has the answers of mj_ray and mj_multiRay, which are float64, and follows mujoco-warp."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.refused import refused
from wrt.compat.mujoco import from_mujoco

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

CUBE = "-1 -1 -1  1 -1 -1  1 1 -1  -1 1 -1  -.7 -1 1  1 -.6 1  1 1 1.3  -1 .5 1"
HEIGHTS = np.random.default_rng(1).random((7, 9))
HEIGHTS[0], HEIGHTS[1, 2] = 0.0, 1.0
SHAPES = ('type="sphere" size=".3"', 'type="capsule" size=".2 .3" group="1"', 'type="ellipsoid" size=".2 .3 .4" group="2"',
          'type="cylinder" size=".2 .3"', 'type="box" size=".2 .3 .1"', 'type="mesh" mesh="scaled"', 'type="mesh" mesh="mirrored"')
BODIES = "".join(f'<body pos="{i % 3 - 1} {i // 3 - 1} 1" euler="{30 * i} {40 * i} 0"><freejoint/><geom {shape}/></body>'
                 for i, shape in enumerate(SHAPES))
XML = f"""<mujoco><asset><mesh name="scaled" vertex="{CUBE}" scale=".2 .3 .15"/><mesh name="mirrored" vertex="{CUBE}" scale="-.2 .3 .25"/>
<hfield name="h" nrow="7" ncol="9" size="1.5 1 .6 .2" elevation="{' '.join(map(str, HEIGHTS.ravel()))}"/></asset>
<worldbody><geom type="plane" size="0 6 .1"/><geom type="plane" size="1 .5 .1" pos="0 0 3" euler="30 0 0"/>
<geom type="hfield" hfield="h" pos="-3 1 .3" euler="0 0 30"/><geom type="sphere" size=".2" pos="0 0 .7" rgba="1 1 1 0"/>{BODIES}
</worldbody></mujoco>"""
ORIGINS = ((0.3, 0.2, 4.0), (0.0, 0.0, 0.5), (-3.0, 1.0, 0.25), (-3.2, 1.1, 0.6), (-1.0, -1.0, 1.0), (2.0, 2.0, -1.0))


def make(xml: str = XML, steps: int = 0) -> tuple[Any, Any]:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    mujoco.mj_kinematics(model, data)
    return model, data


@pytest.fixture(scope="module")
def scene() -> tuple[Any, Any, Any]:
    model, data = make()
    return model, data, from_mujoco(model, data, device="cpu")


def directions(n: int) -> np.ndarray:
    """Return directions of many lengths that are exact in float32."""
    return np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32).astype(np.float64)


def arrays(n: int) -> list[np.ndarray]:
    return [np.full(n, -7, np.int32), np.full(n, -7.0), np.full(3 * n, -7.0)]


def compare(model: Any, data: Any, own: Any, origin: Any, n: int = 2000, groups: Any = None, static: bool = True, body: int = -1) -> int:
    """Compare answers with those of mj_ray, ray by ray; return how many geoms differ. All of these are at rims: mj_ray finds our geom
    with a direction beside it, and one of both is curved. Points are on the surface, or as far below it as a mesh of 128 segments is."""
    origin, vec = np.array(origin, np.float32).astype(np.float64), directions(n)
    geom, dist, normal = arrays(n)
    own.multi_ray(origin, vec.ravel(), groups, static, body, geom, dist, normal, n)
    differ, curved = 0, np.isin(np.append(model.geom_type, 0), (2, 3, 4, 5))
    for i, v in enumerate(vec):
        their, turned = np.empty(1, np.int32), np.empty(3)
        t = mujoco.mj_ray(model, data, origin, v, groups, static, body, their, turned)
        if their[0] != geom[i]:
            near, differ, step = np.empty(1, np.int32), differ + 1, 5e-3 if curved[their[0]] or curved[geom[i]] else 1e-6
            found = {int(near[0]) for e in np.linalg.norm(v) * directions(200)
                     if mujoco.mj_ray(model, data, origin, v + step * e, groups, static, body, near, None)}
            assert geom[i] in found, (i, their, geom[i])
        elif t >= 0.0:  # distance of our point from the plane that touches the geom at theirs
            most = 1.2e-3 * model.geom_size[geom[i]].max() if curved[geom[i]] else 1e-6 * (2.0 + t * np.linalg.norm(v))
            assert abs(t - dist[i]) * abs(turned @ v) <= most, (i, t, dist[i], their)
        else:
            assert dist[i] == -1.0 and not normal[3 * i : 3 * i + 3].any()
    return differ


@pytest.mark.parametrize("steps", [0, 60])
def test_hits_of_every_kind_of_geom(scene: Any, steps: int) -> None:
    model, _, own = scene
    _, data = make(steps=steps)
    own.follow(data)
    assert sum(compare(model, data, own, origin) for origin in ORIGINS) <= 6  # of 12,000


def test_normals(scene: Any) -> None:
    model, data, own = scene
    own.follow(data)
    (a, _, theirs), (b, _, ours), vec = arrays(5000), arrays(5000), directions(5000).ravel()
    mujoco.mj_multiRay(model, data, np.array(ORIGINS[1]), vec, None, True, -1, a, np.empty(5000), theirs, 5000, 1e10)
    own.multi_ray(ORIGINS[1], vec, None, True, -1, b, np.empty(5000), ours, 5000)
    off = np.abs(theirs - ours).reshape(-1, 3).max(axis=1)[a == b]
    curved = np.isin(model.geom_type, (2, 3, 4, 5))[a[a == b]] & (a[a == b] >= 0)
    assert np.count_nonzero(off[curved] > 0.05) <= 5 and np.count_nonzero(off[~curved] > 1e-5) <= 3  # edges have two normals
    assert len(np.unique(a)) >= 9


def test_groups_static_geoms_bodies_and_cutoff(scene: Any) -> None:
    model, data, own = scene
    own.follow(data)
    for groups, static, body in (([1, 0, 1, 1, 1, 1], True, -1), ([0, 1, 1, 0, 0, 0], True, -1), (None, False, -1), (None, True, 5),
                                 ([0] * 6, True, 0)):
        compare(model, data, own, ORIGINS[1], 500, None if groups is None else np.array(groups, np.uint8), static, body)
    for cutoff in (0.4, 1.0, 2.5):
        (a, t, _), (b, own_t, _) = arrays(3000), arrays(3000)
        vec = directions(3000).ravel()
        mujoco.mj_multiRay(model, data, np.array(ORIGINS[1]), vec, None, True, -1, a, t, None, 3000, cutoff)
        own.multi_ray(ORIGINS[1], vec, None, True, -1, b, own_t, None, 3000, cutoff)
        assert np.count_nonzero(a != b) <= 3
    geom, normal = np.empty(1, np.int32), np.empty(3)
    assert own.ray(ORIGINS[0], (0.0, 0.0, -1.0), None, True, -1, geom, normal) == pytest.approx(
        mujoco.mj_ray(model, data, np.array(ORIGINS[0]), np.array([0.0, 0.0, -1.0]), None, True, -1, None), rel=1e-6)


def test_rays_that_are_not_finite_miss_and_edges_of_height_fields_are_closed(scene: Any) -> None:
    _, data, own = scene
    own.follow(data)
    for vec in ((0.0, 0.0, 0.0), (np.nan, 0.0, 1.0), (np.inf, 0.0, 0.0)):
        geom = np.zeros(1, np.int32)
        assert own.ray(ORIGINS[0], vec, geomid=geom) == -1.0 and geom[0] == -1
    place, turn = data.geom_xpos[2], data.geom_xmat[2].reshape(3, 3)
    rows, columns = np.meshgrid(np.linspace(-1.0, 1.0, 7), np.linspace(-1.5, 1.5, 9), indexing="ij")
    points = np.stack([columns, rows, 0.6 * HEIGHTS], axis=-1).reshape(-1, 3) * [0.999999, 0.999999, 1.0]  # also at the rim
    vec = points @ turn.T + place - (-3.0, 1.0, 0.2)  # from inside the base
    geom, dist, _ = arrays(len(vec))
    own.multi_ray((-3.0, 1.0, 0.2), vec.ravel(), None, True, -1, geom, dist, None, len(vec))
    assert (geom == 2).all()


def test_worlds_of_mujoco_warp(scene: Any) -> None:
    warp_mujoco = pytest.importorskip("mujoco_warp", reason="mujoco-warp is not installed")
    model, data = make()
    theirs = warp_mujoco.put_model(model)
    with wp.ScopedDevice("cpu"):
        state = warp_mujoco.put_data(model, data, nworld=3)
        own, n = from_mujoco(model, state), 300
        poses = state.qpos.numpy().copy()
        poses[:, 2::7] += [[0.0], [0.3], [0.6]]
        state.qpos.assign(poses)
        warp_mujoco.kinematics(theirs, state)
        own.follow(state)
    vec = directions(n)
    for world in range(3):
        each = mujoco.MjData(model)
        each.qpos[:] = poses[world]
        mujoco.mj_kinematics(model, each)
        hits = own.accel.closest_hit(np.tile(ORIGINS[0], (n, 1)), vec, world=world)
        found = np.append(own.geom, -1)[hits.object]
        single = from_mujoco(model, each, device="cpu")
        geom, dist, _ = arrays(n)
        single.multi_ray(ORIGINS[0], vec.ravel(), None, True, -1, geom, dist, None, n)
        assert np.count_nonzero(geom != found) <= 1 and compare(model, each, single, ORIGINS[0], n) <= 1
        assert np.isfinite(hits.t).any() and np.allclose(hits.t[hits.hit], dist[hits.hit], atol=1e-5)
    with refused(None, "one world", place="multi_ray"):
        own.ray(ORIGINS[0], (0.0, 0.0, 1.0))
    rng, group = np.random.default_rng(3), [-1.0] * 6
    vec, body = directions(n) / np.linalg.norm(directions(n), axis=1, keepdims=True), rng.integers(-1, model.nbody, n)
    with wp.ScopedDevice("cpu"):
        for rows, groups, static in ((1, group, True), (3, [1.0, 0.0, 1.0, 1.0, 1.0, 1.0], True), (3, group, False)):
            pnt = wp.array(rng.choice(ORIGINS[:2] + ORIGINS[4:], (rows, n)), dtype=wp.vec3)
            rays = pnt, wp.array(np.tile(vec, (rows, 1, 1)), dtype=wp.vec3), groups, static, wp.array(body, dtype=wp.int32)
            (t, geom, normal), (own_t, own_geom, own_normal) = answers = [
                [wp.full((3, n), -7, dtype=kind) for kind in (wp.float32, wp.int32, wp.vec3)] for _ in range(2)]
            warp_mujoco.rays(theirs, state, *rays[:2], warp_mujoco._src.types.vec6f(*groups), *rays[3:], *answers[0])
            own.rays(*rays, *answers[1])
            same = geom.numpy() == own_geom.numpy()
            flat = same & ~np.isin(np.append(model.geom_type, 0), (2, 3, 4, 5))[geom.numpy()]
            assert np.count_nonzero(~same) <= 3 and same.any() and (geom.numpy() == -1).any()
            assert np.allclose(t.numpy()[flat], own_t.numpy()[flat], rtol=1e-5, atol=1e-5)
            assert np.count_nonzero(np.abs(normal.numpy() - own_normal.numpy())[flat].max(axis=1) > 1e-4) <= 1  # edges have two
        with refused("bodyexclude", "300"):
            own.rays(*rays[:4], wp.zeros(n, dtype=wp.float32), *answers[1])
        with refused("dist", "(3, 300)"):
            own.rays(*rays, wp.zeros((1, n), dtype=wp.float32), *answers[1][1:])


def test_planes_that_fit_in_no_mask() -> None:
    xml = "".join(f'<geom type="plane" size="0 0 1" pos="0 0 {-i}" euler="{180 * (i % 2)} 0 0"/>' for i in range(33))
    with pytest.warns(UserWarning, match="geom 31 '', geom 32"):
        own = from_mujoco(make(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")[0], device="cpu")
    geom = np.empty(1, np.int32)
    assert own.ray((0.0, 0.0, -28.5), (0.0, 0.0, -1.0), geomid=geom) == 1.5 and geom[0] == 30
    assert own.ray((0.0, 0.0, -28.5), (0.0, 0.0, 1.0), geomid=geom) == 1.5 and geom[0] == 27


def test_what_is_refused(scene: Any) -> None:
    _, data, own = scene
    with refused("model", "mujoco.MjModel"):
        from_mujoco(data)
    with refused("model", "no geom"):
        from_mujoco(make("<mujoco/>")[0])
    with refused("data", "geom_xpos"):
        own.follow(make('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')[1])
    with refused("dist", "4"):
        own.multi_ray((0, 0, 0), np.ones(12), None, True, -1, None, np.empty(5), None, 4)
    with refused("geomgroup", "6"):
        own.ray((0, 0, 0), (0, 0, 1), [1, 0])
