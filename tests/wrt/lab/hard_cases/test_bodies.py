"""wrt.testing.bodies: right answers pass, and each kind of wrong answer is counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wrt
from tests.simulators import Answer, with_warp, with_wrt
from wrt.core.errors import InputError
from wrt.lab.hard_cases.bodies import CASES
from wrt.testing import Bodies, bodies

RAYS = 400


def test_no_ray_of_wrt_is_wrong() -> None:
    report = bodies(with_wrt, rays=RAYS)
    assert report.ok and report.total.rays == RAYS * len(CASES), str(report)


def test_few_rays_of_other_code_are_wrong() -> None:
    """Warp's meshes leak at edges and corners; nearly all other answers are right, by code that shares nothing with wrt."""
    report = bodies(with_warp, rays=RAYS)
    assert all(result.raised is None for result in report.results) and report.total.wrong < 0.01 * report.total.rays, str(report)


def without_move(case: Bodies) -> Answer:
    return with_wrt(case, move=False)


def without_exclusion(case: Bodies) -> Answer:
    return with_wrt(case, exclude=False)


def without_mirror(case: Bodies) -> Answer:
    return with_wrt(replace(case, mirrored=np.zeros_like(case.mirrored)))


def in_one_world(case: Bodies) -> Answer:
    return with_wrt(replace(case, ray_world=np.zeros_like(case.ray_world), exclude=np.full_like(case.exclude, -1)))


def off(case: Bodies) -> Answer:
    t, body = with_wrt(case)
    return t * 1.01, body


def losing(case: Bodies) -> Answer:
    t, body = with_wrt(case)
    return t, np.where(np.arange(len(body)) % 10 == 0, -1, body)


def swapped(case: Bodies) -> Answer:
    t, body = with_wrt(case)
    return t, np.where(body >= 0, body ^ 1, -1)


@pytest.mark.parametrize(("trace", "case", "count"), [
    (without_move, "J_moved", "lost"), (without_move, "J_moved", "invented"), (without_exclusion, "J_excluded", "invented"),
    (without_mirror, "J_mirrored", "invented"), (in_one_world, "J_worlds", "invented"), (off, "J_tiles", "invented"),
    (losing, "J_tiles", "lost"), (swapped, "J_moved", "invented"),
])
def test_wrong_answers_are_counted(trace, case: str, count: str) -> None:
    (result,) = bodies(trace, case, RAYS).results
    assert getattr(result, count) > 0.01 * RAYS and not result.ok


def test_places_are_exact() -> None:
    for make in CASES.values():
        case = make(np.random.default_rng(5), 10)
        linear = case.to_world[:, :, :3]
        assert (np.sort(np.abs(linear), axis=1) == [[[0], [0], [1]]]).all()
        assert (np.sign(np.linalg.det(linear)) == np.where(case.mirrored, -1, 1)).all()
        for body in range(len(case.mesh)):
            exact = case.meshes[case.mesh[body]].vertices.astype(np.float64) @ linear[body].T + case.position[body]
            assert (case.placed(body).vertices == exact).all()


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="J_mooved"):
        bodies(with_wrt, "J_mooved")
    with pytest.raises(InputError, match="closest_body"):
        bodies(lambda case: (np.zeros(3), np.zeros(3)), "J_moved", RAYS)
    (result,) = bodies(lambda case: 1 / 0, "J_moved", RAYS).results
    assert isinstance(result.raised, ZeroDivisionError) and not result.ok
    assert wrt.testing.bodies is bodies
