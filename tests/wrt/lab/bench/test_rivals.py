"""The package docs/extensions/rivals: Embree's packets and tinybvh get the same rays, and answer as wrt does."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data import ROOT
from tests.refused import refused
from wrt.lab.bench import Queries, contestants
from wrt.lab.bench.contestants import Own, contestant
from wrt.lab.bench.queries import means
from wrt.lab.bench.report import run
from wrt.lab.hard_cases.cases import chunks
from wrt.scene.shapes import icosphere

# The parts of tinybvh's interface that wrt uses, over all triangles without a tree: Moeller and Trumbore 1997 in double precision.
HEADER = """
#include <cmath>
#include <cstdint>
#include <cstring>
#define TINY_BVH_VERSION_MAJOR 1
#define TINY_BVH_VERSION_MINOR 2
#define TINY_BVH_VERSION_SUB 3
#define BVH_FAR 1e30f
#define BVH_USEAVX2
namespace tinybvh {
struct bvhvec3 { float x, y, z; bvhvec3() = default; bvhvec3(float a, float b, float c) : x(a), y(b), z(c) {} };
struct bvhvec4 { float x, y, z, w; };
struct Ray {
    double o[3], d[3]; struct { float t, u, v; uint32_t prim; } hit;
    Ray(bvhvec3 a, bvhvec3 b, float t) : o{a.x, a.y, a.z}, d{b.x, b.y, b.z} {
        double l = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]); for (double& x : d) x /= l; hit = {t, 0, 0, 0}; }
};
inline void cross(const double* a, const double* b, double* c) { for (int i = 0; i < 3; ++i) {
    int j = (i + 1) % 3, k = (i + 2) % 3; c[i] = a[j] * b[k] - a[k] * b[j]; } }
inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
struct All {
    const bvhvec4* corners; uint32_t n;
    void BuildHQ(const bvhvec4* c, uint32_t count) { corners = c; n = count; }
    int Intersect(Ray& ray) const {
        for (uint32_t i = 0; i < n; ++i) {
            const bvhvec4 *a = corners + 3 * i, *b = a + 1, *c = a + 2;
            double e[3] = {b->x - a->x, b->y - a->y, b->z - a->z}, f[3] = {c->x - a->x, c->y - a->y, c->z - a->z};
            double s[3] = {ray.o[0] - a->x, ray.o[1] - a->y, ray.o[2] - a->z}, p[3], q[3]; cross(ray.d, f, p); cross(s, e, q);
            double det = dot(e, p), u = dot(s, p) / det, v = dot(ray.d, q) / det, t = dot(f, q) / det;
            if (u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < ray.hit.t) ray.hit = {(float)t, (float)u, (float)v, i};
        }
        return 0;
    }
    bool IsOccluded(const Ray& ray) const { Ray copy = ray; Intersect(copy); return copy.hit.t < ray.hit.t; }
};
typedef All BVH4_CPU; typedef All BVH8_CPU;
}
"""


@pytest.fixture
def rivals(monkeypatch: pytest.MonkeyPatch) -> Any:
    spec = importlib.util.spec_from_file_location("rivals", ROOT / "docs" / "extensions" / "rivals" / "rivals.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not any(map(shutil.which, module.COMPILERS)):
        pytest.skip("needs a C++ compiler")
    for kind in (module.EmbreePackets, module.TinyBvh):
        monkeypatch.setitem(contestants.LIBRARIES, kind.NAME, kind)
    return module


@pytest.mark.parametrize("name", ["embree16", "embree16:rays=incoherent", "tinybvh", "tinybvh:width=4"])
def test_rays_and_segments_are_passed_rightly(name: str, rivals: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name.startswith("embree"):
        pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    else:
        (tmp_path / "tiny_bvh.h").write_text(HEADER)
        monkeypatch.setenv("TINYBVH", str(tmp_path))
    rows = run(Queries(("bvh8", name, "warp"), (icosphere(2),), ("primary", "shadow", "diffuse"), number=500, runs=1))
    assert [row.differ for row in rows if row.name == name] == [0] * 3 and 0.1 < rows[0].hit < 0.9
    assert [row.wrong for row in rows if row.name == name] == [0] * 3
    one, own = contestant(name), Own()
    case = next(chunks("H_scale_1_uniform", 300))
    for each in (one, own):
        each.prepare(case.geometry)
    found, truth = (each.closest(case.origins, 3.0 * case.directions) for each in (one, own))
    np.testing.assert_array_equal(found.prim_id, truth.prim_id)
    for a, b in ((found.t, truth.t), (found.u, truth.u), (found.v, truth.v)):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_packets_are_modes_of_embree(rivals: Any) -> None:
    pytest.importorskip("embreex", reason='needs embreex: pip install "wrt[peers]"')
    rows = run(Queries(("bvh8", "embree", "embree16"), (icosphere(2),), ("primary",), number=500, runs=1))
    assert set(means(rows)) == {"embree", "embree16", "embree, best"}


def test_what_tinybvh_needs_is_told(rivals: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TINYBVH", str(tmp_path))
    with refused("contestants", "TINYBVH names no folder"):
        Queries(("tinybvh",))
    (tmp_path / "tiny_bvh.h").write_text("#error broken\n")
    with refused(what="fails"):
        Queries(("tinybvh",))
    monkeypatch.setenv("PATH", "")
    with refused(what="need a C++ compiler"):
        rivals.compiled(str(tmp_path / "other"))
