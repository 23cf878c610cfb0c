"""Ray libraries as functions, and the command that compares them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.command_line import wrt as run
from wrt.lab.bench import report
from wrt.lab.hard_cases import libraries
from wrt.lab.hard_cases.comparison import parts
from wrt.lab.hard_cases.conformance import Case
from wrt.lab.hard_cases.libraries import LIBRARIES, Library, usable
from wrt.lab.plans import HardCases


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_library_answers_as_wrt_where_it_is_easy(name: str) -> None:
    if reason := usable(name):
        pytest.skip(reason)
    part = next(Case("H_scale_1_uniform", 500).parts)
    for away in (0.5, 3.0):  # hits; hits and misses
        rays = part.geometry.vertices, part.geometry.faces, np.float32(away) * part.origins, 3.0 * part.directions
        (t, prim_id), own = (each if isinstance(each, tuple) else (each.t, each.prim_id)
                             for each in (LIBRARIES[name].closest_hit(*rays), LIBRARIES["wrt"].closest_hit(*rays)))
        same = prim_id == own[1]
        assert same.mean() > 0.99 and prim_id.shape == t.shape == (len(part),) and (away == 0.5) == (prim_id >= 0).all()
        hit = same & (prim_id >= 0)
        np.testing.assert_allclose(t[hit], own[0][hit], rtol=1e-4)


def test_what_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = Library("Nowhere", LIBRARIES["wrt"].closest_hit, ["no_such_package_at_all"])
    monkeypatch.setitem(libraries.LIBRARIES, "nowhere", nowhere)
    plan = HardCases(("D_published",), libraries=("nowhere",), rays=5)
    found = report.run(plan)
    assert [row.missing for row in found] == ["not installed: no_such_package_at_all"]
    assert parts(found, plan)[0].text == "Nowhere: not installed: no_such_package_at_all."


def test_errors_are_counted_beside_wrong_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: np.ndarray) -> None:
        raise RuntimeError("no")

    monkeypatch.setitem(libraries.LIBRARIES, "wrt", Library("wrt", broken))
    plan = HardCases(("D_published", "I_mesh_not_finite"), libraries=("wrt",), rays=5)
    found = parts(report.run(plan), plan)
    assert ("all", "10", "0 and 1 errors") in found[0].lines
    assert [line[:2] for line in found[1].lines] == [("D_published", "5"), ("I_mesh_not_finite", "5")]


def test_the_command() -> None:
    result = run("bench", "hard-cases", "E_grid", "D_published", "--libraries", "wrt,warp", "--rays", "50")
    assert result.code == 0 and "Warp  E_grid  50" in result.err
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in result.out.splitlines() if line.startswith("|")]
    assert lines[0] == ["group", "rays", "wrt", "Warp"] and ["lost", "", "0", "0"] in lines
    assert ["E_grid", "50", "0 / 0", "0 / 0"] in lines
    for arguments, said in ((("Q",), "no hard case 'Q'"), (("--libraries", "nothing"), "no library 'nothing'"),
                            (("--rays", "0"), "rays must be 1 to")):
        result = run("bench", "hard-cases", *arguments)
        assert result.code == 2 and said in result.err
