"""`bench claims`: verdicts, reports, and all claims on small scenes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import wrt
from tests.refused import refused
from wrt.lab.bench import claims as bench
from wrt.lab.bench.meshes import terrain
from wrt.lab.bench.report import Row, markdown, run
from wrt.lab.claims import Claims as Plan
from wrt.lab.claims import scenes
from wrt.lab.claims.claim import CLAIMS, Claim, Figure, Study
from wrt.lab.claims.scenes import PATH, open_scene, scene_files
from wrt.scene.shapes import icosphere


@pytest.fixture(autouse=True)
def _small_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scenes.STAND_INS, "bunny", ("ball", lambda: icosphere(4)))
    monkeypatch.setitem(scenes.STAND_INS, "sponza", ("terrain", lambda: terrain(40)))


@pytest.mark.parametrize(("ours", "published", "unit", "ratio", "verdict"), [
    (2.0, None, "nodes", None, "own finding"), (2.0, 3.0, "nodes", 2.0 / 3.0, "agrees"), (2.0, 3.1, "nodes", 2.0 / 3.1, "differs"),
    (3.0, 2.0, "nodes", 1.5, "agrees"), (50.0, (30.0, 70.0), "%", 1.0, "agrees"), (80.0, (30.0, 50.0), "%", 1.6, "differs"),
    (1.1, 0.9, "ratio", 1.1 / 0.9, "differs"), (0.0, 0.0, "rays", 1.0, "agrees"), (1.0, 0.0, "rays", np.inf, "differs"),
    (-10.0, (50.0, 70.0), "%", -0.2, "differs")])
def test_a_number_agrees_within_the_factor_and_in_order(ours: float, published: float | tuple[float, float] | None, unit: str,
                                                        ratio: float | None, verdict: str) -> None:
    figure = Figure("", ours, published, unit)
    assert figure.verdict == verdict and figure.ratio == (ratio if ratio is None else pytest.approx(ratio))


@pytest.mark.parametrize("name", CLAIMS)
def test_every_claim_says_what_differs_and_why(name: str) -> None:
    claim = CLAIMS[name]
    figures = list(claim.measure(Study(side=16)))
    assert figures and claim.source and claim.setup and claim.sure in ("read", "quoted", "abstract")
    for figure in figures:
        assert np.isfinite(figure.ours) and figure.what
        if figure.published is not None:
            assert figure.differences
        if figure.verdict == "differs":
            assert any(letter.isdigit() for letter in figure.reason)  # a measurement, not a guess


def test_equal_options_give_equal_rows() -> None:
    plan = Plan(names=("ttp-nodes", "coop-rt"), side=16)
    one, two = ([row.as_dict() for row in run(plan)] for _ in range(2))
    assert one == two and {row["claim"] for row in one} == {"ttp-nodes", "coop-rt"}


def test_the_report_has_the_numbers_and_the_sources() -> None:
    plan = Plan(names=("ttp-nodes",), side=16)
    text = markdown(bench.parts(run(plan), plan))
    assert "arXiv 2605.16253, Table I" in text and "of 6 compared numbers agree" in text


def claims_rows(count: int) -> list[Row]:
    """Return rows of `count` claims with two numbers each, one of which differs."""
    figures = (Figure("first", 2.0, 3.0, "nodes", "scene a; own camera; half of it", "10 of 20"),
               Figure("second", 2.0, 9.0, "nodes", "scene b; own camera", ""))
    claim = Claim("authors, Figure 1", "their scene", "read", lambda study: iter(figures))
    return [Row(claim=f"c{i}", **vars(each), ratio=each.ratio, verdict=each.verdict, **{name: getattr(claim, name) for name in
                ("source", "setup", "sure")}) for i in range(count) for each in figures]


def test_the_report_has_a_list_item_for_each_claim() -> None:
    text = bench.parts(claims_rows(2), Plan())[-1].text
    first = "- **c0**: authors, Figure 1 (read). Published set-up: their scene."
    figures = ["  - *first*: scene a; own camera; half of it; measured: 10 of 20", "  - *second*: scene b; own camera"]
    assert text.split("\n") == [first, *figures, first.replace("c0", "c1"), *figures]


def test_the_command_takes_a_file_for_a_published_scene(tmp_path: Path) -> None:
    ball = icosphere(4)
    path = tmp_path / "bunny.obj"
    path.write_text("\n".join([*("v " + " ".join(map(str, v)) for v in ball.vertices.tolist()),
                               *("f " + " ".join(map(str, f)) for f in (ball.faces + 1).tolist())]) + "\n")
    arguments = ["bench", "claims", "repacking", "--side", "16", "--scene", f"bunny={path}"]
    data = json.loads(wrt(*arguments, "-q", "--json").out)
    assert data["compared"] == 2 and data["rows"][0]["differences"].startswith(f"scene bunny: {len(ball.faces)} triangles, the caller's")
    assert wrt(*arguments, "-o", tmp_path / "report.csv").code == 0
    lines = list(csv.DictReader((tmp_path / "report.csv").read_text().splitlines()[2:]))
    assert [float(line["ours"]) for line in lines] == [row["ours"] for row in data["rows"]]
    assert wrt("bench", "claims", "nonsense").code == 2
    assert wrt("bench", "claims", "repacking", "-o", tmp_path / "x.pdf").code == 2


def test_scenes_need_a_known_name_and_a_file() -> None:
    assert scene_files(("bunny=a=b.ply",)) == {"bunny": "a=b.ply"}
    with refused("scene", what="no file", hint="bunny=FILE"):
        scene_files(("bunny",))
    with refused("scene", what="scene"):
        Plan(scene=("bunnny=a.ply",))


def test_rays_of_paths_start_at_hits_and_stay_in_their_warps() -> None:
    scene = open_scene("bunny", None, 24)
    rays = scene.workloads[PATH]
    camera = (rays.depth == 0) & (rays.kind == 0)
    assert camera.sum() == 24 * 24 and (np.diff(rays.warp) >= 0).all() and np.bincount(rays.warp).max() <= 32
    hits = scene.accel.closest_hit(rays.origins[camera], rays.directions[camera])
    shadow = (rays.depth == 0) & (rays.kind == 1)
    assert set(rays.pixel[shadow]) == set(rays.pixel[camera][hits.prim_id >= 0])
    block = rays.pixel // 24 // 4 * 3 + rays.pixel % 24 // 8
    assert all(len(set(block[rays.warp == warp])) == 1 for warp in np.unique(rays.warp))
