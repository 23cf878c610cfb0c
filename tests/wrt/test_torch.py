"""wrt.torch: the adjoint in torch's autograd, against autograd of the closed form in float64."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

import wrt
from tests.data import ROOT
from tests.wrt.accel.queries.test_gradients import N, cotangents, facing, rays, soup
from wrt.accel import tensors
from wrt.core.errors import InputError
from wrt.scene import shapes

MISSING = "wrt does not need {0}: the extra {0} brings it"


@pytest.mark.parametrize("name", ["torch", "jax"])
def test_where_the_library_is_missing_it_says_how_to_get_it(name: str) -> None:
    code = (f"import sys; sys.modules['{name}'] = None\nimport wrt\ntry:\n    wrt.{name}.closest_hit(None, None, None, None)\n"
            "except wrt.InputError as error:\n    print(error)")
    said = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert f'pip install "wrt[{name}]"' in said and said.startswith(f"wrt.{name} needs {name}")


def closed_form(torch: Any, vertices: Any, faces: Any, o: Any, d: Any) -> tuple[Any, ...]:
    """t, u, v and the point of rays that hit `faces`."""
    v0, v1, v2 = (vertices[faces[:, i]] for i in range(3))
    solution = torch.linalg.solve(torch.stack([d, v0 - v1, v0 - v2], dim=2), v0 - o)
    return *solution.unbind(dim=1), o + solution[:, :1] * d


def test_against_autograd_in_float64_for_10_000_random_hits() -> None:
    torch = pytest.importorskip("torch", reason=MISSING.format("torch"))
    rng = np.random.default_rng(7)
    mesh = soup(rng)
    origins, directions = rays(rng, 40_000)
    chosen = np.nonzero(wrt.build(mesh).closest_hit(origins, directions).prim_id >= 0)[0][:N]
    given = cotangents(rng, N)
    arrays, grads = (mesh.vertices, origins[chosen], directions[chosen]), []
    for dtype in (torch.float32, torch.float64):
        leaves = [torch.tensor(each, dtype=dtype, requires_grad=True) for each in arrays]
        if dtype == torch.float32:
            found = wrt.torch.closest_hit(wrt.build(mesh), *leaves)
            assert (found.prim_id >= 0).all() and not found.prim_id.requires_grad
            parts = found[:4]
        else:
            parts = closed_form(torch, leaves[0], torch.tensor(mesh.faces)[found.prim_id], *leaves[1:])
        loss = sum((torch.tensor(weight, dtype=dtype) * part).sum() for weight, part in zip(given, parts, strict=True))
        grads.append([each.numpy().astype(np.float64) for each in torch.autograd.grad(loss, leaves)])
    (vertices, *of_rays), (true_vertices, *true_rays) = grads
    error, norm = (np.linalg.norm(np.concatenate(each, axis=1), axis=1) for each in
                   ([a - b for a, b in zip(of_rays, true_rays, strict=True)], true_rays))
    print(f"relative error of a ray's 6 derivatives: {(error / norm).max():.1e} at most, {np.median(error / norm):.1e} median;"
          f" of all vertices' {np.linalg.norm(vertices - true_vertices) / np.linalg.norm(true_vertices):.1e}")
    assert (error / norm).max() < 1e-4
    assert np.linalg.norm(vertices - true_vertices) < 1e-4 * np.linalg.norm(true_vertices)
    corners = mesh.vertices[mesh.faces[found.prim_id.numpy()]].astype(np.float64)
    assert np.abs(facing(corners, directions[chosen].astype(np.float64))).min() < 0.01  # some are grazing


def test_values_dtypes_and_misses() -> None:
    torch = pytest.importorskip("torch", reason=MISSING.format("torch"))
    ball, accel = shapes.icosphere(2), wrt.build(shapes.icosphere(2))
    origins, directions = rays(np.random.default_rng(8), 200)
    larger = np.float32(1.3) * ball.vertices
    vertices = torch.tensor(larger, dtype=torch.float64, requires_grad=True)
    found = wrt.torch.closest_hit(accel, vertices, torch.tensor(origins), torch.tensor(directions), t_max=torch.full((200,), 4.0))
    again = wrt.build((larger, ball.faces)).closest_hit(origins, directions, t_max=4.0)
    for name in ("t", "u", "v", "prim_id", "point"):
        np.testing.assert_array_equal(getattr(found, name).detach().numpy(), getattr(again, name))
    assert 20 < (found.prim_id >= 0).sum() < 180
    before = accel.geometry
    hit = found.prim_id >= 0
    (found.t[hit].sum() + found.point[hit].sum()).backward()
    assert vertices.grad.dtype == torch.float64 and torch.isfinite(vertices.grad).all() and vertices.grad.abs().max() > 0.0
    with torch.no_grad():
        wrt.torch.closest_hit(accel, vertices, origins, directions)
    assert accel.geometry is before  # the same vertices: nothing to follow
    rays_only = torch.tensor(origins, requires_grad=True)
    found = wrt.torch.closest_hit(accel, None, rays_only, directions)
    torch.where(found.prim_id >= 0, found.t, 0.0).sum().backward()
    assert torch.isfinite(rays_only.grad).all() and not rays_only.grad[found.prim_id < 0].any()
    with pytest.raises(InputError, match="structure over one mesh"):
        wrt.torch.closest_hit(ball, None, origins, directions)


def test_vertices_that_are_written_to_are_followed() -> None:
    torch = pytest.importorskip("torch", reason=MISSING.format("torch"))
    ball, (o, d) = shapes.icosphere(2), map(torch.tensor, rays(np.random.default_rng(11), 50))
    for build in (lambda own: wrt.build((own, ball.faces)), lambda own: wrt.build((own.numpy(), ball.faces))):
        vertices = torch.tensor(ball.vertices)
        accel = build(vertices)
        for _ in range(2):
            vertices += 0.1
            found = wrt.torch.closest_hit(accel, vertices, o, d)
            expected = wrt.build((vertices.clone(), ball.faces)).closest_hit(o, d)
            assert (expected.prim_id >= 0).any() and torch.equal(found.t, expected.t)


def test_values_of_vertices_are_read_once_a_version(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason=MISSING.format("torch"))
    ball, (o, d) = shapes.icosphere(2), map(torch.tensor, rays(np.random.default_rng(12), 50))
    accel, vertices, seen = wrt.build(ball), torch.tensor(ball.vertices), list[int]()
    read = tensors.at_vertices
    monkeypatch.setattr(tensors, "at_vertices", lambda *args: (seen.append(1), read(*args))[1])

    def reads(given: Any) -> int:
        before = len(seen)
        found = wrt.torch.closest_hit(accel, given, o, d)
        expected = wrt.build((given.detach().numpy().copy(), ball.faces)).closest_hit(o, d)
        assert (expected.prim_id >= 0).any() and torch.equal(found.t, expected.t)
        return len(seen) - before

    assert [reads(vertices), reads(vertices), reads(vertices.detach().requires_grad_())] == [1, 0, 0]
    vertices *= 1.25
    assert [reads(vertices), reads(vertices), reads(vertices.clone())] == [1, 0, 1]
    assert [reads(0.5 * vertices), reads(2.0 * vertices), reads(vertices.double())] == [1, 1, 1]  # of new tensors, versions are 0
    reads(vertices)
    accel.refit(3.0 * ball.vertices)  # not by this tensor
    assert [reads(vertices), reads(vertices)] == [1, 0]
    with torch.inference_mode():  # which counts no versions
        other = 0.75 * vertices
        assert [reads(other), reads(other)] == [1, 1]


def test_what_the_page_says_runs() -> None:
    torch = pytest.importorskip("torch", reason=MISSING.format("torch"))
    page = (ROOT / "docs" / "gradients.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```py\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    mesh, (origins, directions) = shapes.icosphere(2), map(torch.tensor, rays(np.random.default_rng(10), 50))
    names = {"wrt": wrt, "torch": torch, "mesh": mesh, "accel": wrt.build(mesh), "origins": origins, "directions": directions,
             "points": origins, "vertices": torch.tensor(mesh.vertices)}
    for block in blocks:
        exec(block, names)
    assert len(blocks) == 2 and isinstance(names["inside"], torch.Tensor) and names["vertices"].grad.abs().max() > 0.0
