# %% [markdown]
# # Does a structure pay? Rasterising, refits, and builds made beforehand
# A structure makes each ray cheap, but must be built first. This notebook compares ray casting with the method that needs no structure,
# rasterising. Then the mesh moves, and the structure follows it. Last, a structure is built once and stored in a file.
#
# If the environment variable `WRT_QUICK` is set, pictures and meshes are smaller. The outputs below were made without it. Times depend on
# the machine and on its other work; hits and counts of steps do not.

# %%
import os
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench import report, visibility
from wrt.picture.heatmap import heatmap
from wrt.scene.shapes import teapot

QUICK = "WRT_QUICK" in os.environ
SIZE, RAYS, RUNS, MOST = ((120, 68), 2_000, 1, 5_000) if QUICK else ((320, 180), 200_000, 5, 330_000)
rng = np.random.default_rng(6)

# %% [markdown]
# ## Two orders of one loop
# Which triangle does each pixel show? There are two ways to ask:
# - **Object by object** (*object-centric*, rasterising): for each triangle, for each pixel that it covers, keep the triangle if it is
#   nearer than the one kept before. The distances kept so far are the *z-buffer*.
# - **Pixel by pixel** (*image-centric*, ray casting): for each pixel, find the nearest triangle on its ray.
#
# Both find the same picture. The first two pictures are half done: half of the triangles, or half of the pixels.

# %%
mesh = teapot(24)
camera = wrt.Camera.look_at((1.6, 1.3, 2.4), (0.05, 0.4, 0.0), fov_y=np.radians(32))
frame, tan = camera.camera_to_world, np.tan(camera.fov_y / 2)
local = (mesh.vertices.astype(float) - frame[:3, 3]) @ frame[:3, :3]
depth = -local[:, 2]  # all positive here: the pot is in front of the camera
flat = np.stack([(local[:, 0] / depth / tan * SIZE[1] / SIZE[0] + 1) * SIZE[0] / 2, (1 - local[:, 1] / depth / tan) * SIZE[1] / 2], axis=1)


def cross2(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def rasterize(faces):
    """Return the index of the triangle that each pixel shows, -1 for none, and the number of pixels tested."""
    shown, nearest, tests = np.full(SIZE[::-1], -1), np.zeros(SIZE[::-1]), 0  # of 1 / depth
    for index, face in enumerate(faces):
        corners, inverse = flat[face], 1 / depth[face]
        low, high = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0), np.minimum(np.ceil(corners.max(axis=0)).astype(int), SIZE)
        if (high <= low).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        p = np.stack([x, y], axis=-1) + 0.5  # the middle of each pixel
        edges = np.stack([cross2(corners[i - 1] - corners[i - 2], p - corners[i - 2]) for i in range(3)], axis=-1)
        area = cross2(corners[1] - corners[0], corners[2] - corners[0])
        if area == 0:
            continue
        weights = edges / area
        here = (weights @ inverse) * (weights >= 0).all(axis=-1)  # 1 / depth is linear on the screen
        nearer = here > nearest[y, x]
        nearest[y, x] = np.where(nearer, here, nearest[y, x])
        shown[y, x] = np.where(nearer, index, shown[y, x])
        tests += x.size
    return shown, tests


palette = np.concatenate([rng.integers(60, 240, (len(mesh.faces), 3)), [[255, 255, 255]]]).astype(np.uint8)
half_way, _ = rasterize(mesh.faces[: len(mesh.faces) // 2])
raster, tests = rasterize(mesh.faces)
cast = wrt.build(mesh).closest_hit(*wrt.camera_rays(camera, SIZE)).prim_id.reshape(SIZE[::-1])
half_cast = np.where(np.arange(SIZE[1])[:, None] < SIZE[1] // 2, cast, -1)
wrt.side_by_side({"half of the triangles": palette[half_way], "half of the pixels": palette[half_cast],
                  "all triangles": palette[raster], "all pixels": palette[cast]}, columns=2)

# %%
differ = (raster != cast).sum()
print(f"pixels that differ: {differ} of {raster.size}; the z-buffer tested {tests} pixels for {len(mesh.faces)} triangles")
assert differ <= 1e-3 * raster.size  # pixels whose middle lies on an edge, within a rounding error

# %% [markdown]
# Rasterising looks at each triangle once, also at hidden ones: its time grows with the number of triangles. A ray passes most triangles
# by: its time grows with the depth of the tree, that is with the logarithm of the number of triangles, but each pixel needs a walk of its
# own. `python -m wrt bench visibility` measures both with compiled code, and compares each pixel:

# %%
plan = visibility.Plan(size=64 if QUICK else 256, max_size=128 if QUICK else 1024, max_triangles=MOST, runs=RUNS)
rows = [row for row in report.run(plan) if row.surface == "terrain"]
assert all(row.differ <= 1e-3 * row.pixels for row in rows)
fig, axes = plt.subplots(1, 2, figsize=(9.6, 3.6), dpi=80, layout="constrained")
for ax, sweep, fixed in ((axes[0], "triangles", f"{plan.size} x {plan.size} pixels"), (axes[1], "pixels", "about 80,000 triangles")):
    line = sorted((row for row in rows if row.sweep == sweep), key=lambda row: getattr(row, sweep))
    at = [getattr(row, sweep) for row in line]
    ax.loglog(at, [1e3 * min(row.raster) for row in line], "s-", label="rasterising")
    ax.loglog(at, [1e3 * min(row.cast) for row in line], "o-", label="casting rays")
    ax.loglog(at, [1e3 * (min(row.cast) + row.build) for row in line], "o:", color="C1", label="and building the structure")
    ax.set(xlabel=sweep, ylabel="milliseconds", title=fixed)
axes[0].legend(fontsize=8)
plt.show()
line = sorted((row for row in rows if row.sweep == "triangles"), key=lambda row: row.triangles)
slower = {name: min(getattr(line[-1], name)) / min(getattr(line[0], name)) for name in ("raster", "cast")}
print(f"{line[-1].triangles / line[0].triangles:.0f} times the triangles: "
      f"rasterising takes {slower['raster']:.0f} times as long, casting {slower['cast']:.0f} times")

# %% [markdown]
# For a few large triangles, rasterising wins. For many small ones, casting wins, if the structure serves several pictures: building it
# takes longer than one picture. And only rays can ask for something else than a picture: shadows, reflections, refractions.
#
# ## The mesh moves: refit
# After a motion, the boxes of a BVH no longer fit. To *refit* is to keep the tree and compute its boxes anew, from the leaves to the root.
# That takes a fraction of a build. But neighbours in the tree may move apart: their common box grows. The *SAH cost* (the expected number
# of steps of a random line, see [structures](structures.ipynb)) measures this. Here the pot is twisted:

# %%
pot = teapot(24 if QUICK else 64)


def twisted(turn):
    """Return the vertices, turned about the y axis by an angle in proportion to their height; `turn` (radians) at height 1."""
    x, y, z = pot.vertices.astype(float).T
    angle = turn * y
    return np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], axis=1)


camera_rays = wrt.camera_rays(wrt.Camera.look_at((1.3, 1.2, 2.3), (0, 0.4, 0), fov_y=np.radians(36)), SIZE)
moving = wrt.build(pot, "bvh2")
built_cost = moving.stats.sah_cost
turns, growth, kept, fresh, maps, seconds = np.radians(np.arange(0, 721, 90)), [], [], [], {}, []
for turn in turns:
    refit = moving.refit(twisted(turn))
    start = time.perf_counter()
    new = wrt.build((twisted(turn), pot.faces), "bvh2")
    seconds.append((refit.seconds, time.perf_counter() - start))
    one, two = (accel.closest_hit(*camera_rays, counters=True) for accel in (moving, new))
    assert (one.prim_id == two.prim_id).all() and (one.t == two.t).all()  # the hits do not depend on the tree
    assert np.isclose(refit.growth, moving.stats.sah_cost / built_cost) and not refit.rebuilt
    growth.append(moving.stats.sah_cost)
    kept.append((one.counters.nodes + one.counters.primitives).mean())
    fresh.append((two.counters.nodes + two.counters.primitives).mean())
    maps[turn] = one.counters.nodes + one.counters.primitives, two.counters.nodes + two.counters.primitives, new.stats.sah_cost
assert growth[0] == built_cost and growth[-1] > growth[2] > growth[0]

fig, ax = plt.subplots(figsize=(6.8, 3.4), dpi=80, layout="constrained")
degrees = np.degrees(turns)
ax.plot(degrees, growth, "s-", color="C3", label="refitted: SAH cost")
ax.plot(degrees, [maps[turn][2] for turn in turns], "s:", color="C3", label="new tree: SAH cost")
ax.plot(degrees, kept, "o-", color="C0", label="refitted: steps of the picture's rays")
ax.plot(degrees, fresh, "o:", color="C0", label="new tree: steps of the picture's rays")
ax.set(xlabel="twist, degrees", ylabel="steps per ray", ylim=(0, None))
ax.legend(fontsize=8)
plt.show()
refits, builds = np.median(seconds, axis=0)
print(f"a refit takes {refits / builds:.2f} of a build")

# %%
top = float(np.percentile(maps[turns[4]][0], 99.5))
wrt.side_by_side({f"twisted by {degrees[4]:.0f} degrees, {name}": heatmap(counts.reshape(SIZE[::-1]), "steps of a ray", top=top)
                  for name, counts in zip(("refitted", "new tree"), maps[turns[4]], strict=False)})

# %% [markdown]
# So refit while the cost is low, and build anew when it has grown by a factor: `accel.refit(vertices, rebuild_at=1.5)`.

# %%
again = wrt.build(pot, "bvh2")
done = [again.refit(twisted(turn), rebuild_at=1.5) for turn in turns]
print("rebuilt at:", [f"{angle:.0f} degrees" for angle, refit in zip(degrees, done, strict=True) if refit.rebuilt])
assert any(refit.rebuilt for refit in done) and again.stats.sah_cost < growth[-1]

# %% [markdown]
# ## Built beforehand
# A mesh that never changes can have the best tree, however long its build takes, if the tree is stored (*offline build*). The builder
# `sbvh` also splits triangles; it takes many times as long as `binned`.
# `accel.save(path)` writes it, `wrt.load_accel(path, mesh)` reads it, `python -m wrt build MESH -o FILE.accel` does it from the command
# line. The file holds a checksum of the mesh, so that a tree is never used for another mesh.

# %%
mesh = wrt.Mesh(twisted(turns[-1]), pot.faces, name="pot, twisted twice")
box = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
origins, directions = rng.uniform(*box, (2, RAYS, 3))
directions -= origins
table, first = {}, None
with tempfile.TemporaryDirectory() as folder:
    for builder in ("lbvh", "binned", "sbvh"):
        start = time.perf_counter()
        accel = wrt.build(mesh, "bvh2", builder=builder)
        build = time.perf_counter() - start
        path = Path(folder) / f"{builder}.accel"
        accel.save(path)
        start = time.perf_counter()
        loaded = wrt.load_accel(path, mesh)
        load = time.perf_counter() - start
        times = []
        for _ in range(RUNS):
            start = time.perf_counter()
            hits = loaded.closest_hit(origins, directions)
            times.append(time.perf_counter() - start)
        first = hits if first is None else first
        assert (hits.prim_id == first.prim_id).all() and (hits.t == first.t).all()
        table[builder] = build, load, min(times) / RAYS, path.stat().st_size / len(mesh.faces), loaded.stats.sah_cost
    try:
        wrt.load_accel(path, pot)
        raise AssertionError("the file is of another mesh")
    except wrt.InputError as error:
        print("another mesh is refused:", str(error).rpartition(".accel: ")[2])

# %%
n = np.geomspace(1e3, 1e9, 200)
fig, ax = plt.subplots(figsize=(6.8, 3.4), dpi=80, layout="constrained")
for i, (builder, (build, load, per_ray, size, cost)) in enumerate(table.items()):
    ax.loglog(n, build + n * per_ray, color=f"C{i}", label=f"{builder}: build, then rays")
    ax.loglog(n, load + n * per_ray, ":", color=f"C{i}", label="read from the file, then rays" if i == 0 else None)
    print(f"{builder:12} build {1e3 * build:7.1f} ms, read {1e3 * load:5.1f} ms, {1e9 * per_ray:5.0f} ns a ray, "
          f"{size:.0f} bytes a triangle, SAH cost {cost:.1f}")
ax.set(xlabel="rays", ylabel="seconds")
ax.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Exercises
# **1.** A mesh has $n$ triangles, each covers $c$ pixels of $p$. When should a ray with a cost of $a \log_2 n$ be cheaper than a z-buffer
# with the cost $b + c$ per triangle?
# <details><summary>Solution</summary>
#
# If $p\,a \log_2 n < n\,(b + c)$. If the triangles lie side by side, $nc$ is about $p$ and small triangles cost mostly $b$: rays win for
# $n / \log_2 n > p\,a/b$. With several layers, $nc$ is a multiple of $p$, and rays win earlier.
# </details>
#
# **2.** Why does the refitted tree stay right although its boxes overlap?
# <details><summary>Solution</summary>
#
# A box of a BVH must only *contain* the triangles below it, which a refit ensures. Overlap makes a ray enter more boxes, but it hides no
# triangle. Cells of a grid, an octree, a k-d tree or a BSP tree may not overlap: these must be built anew.
# </details>
#
# **3.** Move all vertices by the same vector, and refit. By how much does the SAH cost grow?
# <details><summary>Solution</summary>
#
# Not at all: every box keeps its size, and the cost is a sum of ratios of areas. `refit.growth` is 1 within rounding. The same holds for
# scaling all axes equally.
# </details>
#
# **4.** After how many rays has `sbvh` paid for its build, compared with `binned`? And if it is read from a file?
# <details><summary>Solution</summary>
#
# `(table["sbvh"][0] - table["binned"][0]) / (table["binned"][2] - table["sbvh"][2])`, if the denominator is positive: about a
# million rays here. To read either tree takes about the same time, so that a stored tree pays after a few rays.
# </details>
