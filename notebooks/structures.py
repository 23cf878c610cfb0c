# %% [markdown]
# # Acceleration structures: the teapot in a stadium
# An acceleration structure saves a ray from being tested against every triangle. Which structure is best, and what does it cost? This
# notebook builds several structures over the same triangles, traces the same rays, counts their steps, and measures their times.
#
# If the environment variable `WRT_QUICK` is set, pictures and meshes are smaller. The outputs below were made without it. Times depend on
# the machine; counts of steps do not.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench import Queries
from wrt.lab.bench.rays import in_stadium, ray_sets
from wrt.lab.bench.report import run
from wrt.picture.heatmap import heatmap
from wrt.scene.shapes import teapot

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP, RAYS = ((160, 90), 1, 2_000) if QUICK else ((390, 220), 16, 20_000)
STRUCTURES = ("bvh2", "kdtree", "octree", "grid")

# %% [markdown]
# Eric Haines (Ray Tracing News, 1988) described the hard case of a uniform grid, a teapot in a stadium. A few large triangles determine
# the size of the grid, and all the small triangles are in one place.

# %%
scene = wrt.load_scene("../scenes/stadium.toml")
views = {"a pot ...": "main", "... in a stadium": "stand"}
wrt.side_by_side({title: wrt.render(scene, camera=camera, size=SIZE, spp=SPP) for title, camera in views.items()})

# %%
pot = teapot(24 if QUICK else 48)
stadium = in_stadium(pot)  # a thousand times as large
extents = {mesh.name: np.ptp(mesh.vertices, axis=0).max() for mesh in (pot, stadium)}
print({name: f"{extent:.3g}" for name, extent in extents.items()}, f"triangles: {len(pot.faces)} and {len(stadium.faces)}")

# %% [markdown]
# ## Steps of a ray
# With `counters=True`, a query counts the nodes (in a grid: cells) that each ray fetches, and the triangles that it tests. Each of these
# is a step. The maps have one ray per pixel: the upper row for the pot alone, the lower row for the pot in the stadium. The colour scale
# is logarithmic, from 1 to 10,000 steps.

# %%
camera = wrt.Camera.look_at((1.25, 1.0, 1.9), (0.03, 0.42, 0.0), fov_y=np.radians(36))
half = tuple(x * 4 // 5 for x in SIZE)
origins, directions = wrt.camera_rays(camera, half)


def steps(accel):
    """Return the number of nodes and triangles of each ray, and the hits."""
    hits = accel.closest_hit(origins, directions, counters=True)
    return hits.counters.nodes + hits.counters.primitives, hits


fig, axes = plt.subplots(2, len(STRUCTURES), figsize=(12.4, 3.9), dpi=80, layout="constrained")
mean = {}
for row, (where, mesh) in enumerate({"alone": pot, "in the stadium": stadium}.items()):
    found = {}
    for ax, name in zip(axes[row], STRUCTURES, strict=True):
        count, found[name] = steps(wrt.build(mesh, name))
        mean[name, where] = count.mean()
        shown = ax.imshow(np.maximum(count, 1).reshape(half[::-1]), norm="log", vmin=1, vmax=1e4, cmap="inferno")
        ax.set(title=f"{name} {where}: {count.mean():,.0f}", xticks=[], yticks=[])
    first = found[STRUCTURES[0]]
    assert all((hits.prim_id == first.prim_id).all() and (hits.t == first.t).all() for hits in found.values())
fig.colorbar(shown, ax=axes, label="steps of a ray", shrink=0.9)
plt.show()

# %% [markdown]
# All structures find the same triangle at the same $t$, to the last bit (the cell checks it). They differ only in cost. The number above
# each map is its mean.

# %%
for name in STRUCTURES:
    alone, there = mean[name, "alone"], mean[name, "in the stadium"]
    print(f"{name:7} {alone:6.1f} steps a ray alone, {there:7.1f} in the stadium: {there / alone:6.1f} times")

# %% [markdown]
# Three structures adapt: they subdivide space where the triangles are, and need only a few more steps. The cells of the grid all have the
# same size, which depends on the stadium. The whole pot is in one or a few cells, and every ray tests all of its triangles.

# %%
cells = np.array(wrt.build(stadium, "grid").built.arrays["n"])
width = extents[stadium.name] / cells.max()
print(f"{cells[0]} x {cells[1]} x {cells[2]} cells, each {width:.1f} wide; the pot: {extents[pot.name]:.1f}")

# %% [markdown]
# ## How fine should cells be?
# Even without a stadium, the size of a grid's cells is a compromise. With few cells, a ray tests many triangles. With many cells, it
# crosses many of them, and memory grows. The default is 2 cells per triangle.

# %%
densities = [0.03, 0.1, 0.5, 2.0, 8.0, 30.0, 100.0]
rows = []
for density in densities:
    grid = wrt.build(pot, "grid", density=density)
    c = grid.closest_hit(origins, directions, counters=True).counters
    rows.append((c.nodes.mean(), c.primitives.mean(), grid.stats.bytes / len(pot.faces)))
walked, tested, size = np.array(rows).T
fig, axes = plt.subplots(1, 2, figsize=(8.0, 3.0), dpi=80, layout="constrained")
axes[0].loglog(densities, walked, "s-", label="cells")
axes[0].loglog(densities, tested, "o-", label="triangles")
axes[0].loglog(densities, walked + tested, "k-", label="both")
axes[0].set(xlabel="cells a triangle", ylabel="a ray")
axes[0].legend()
axes[1].loglog(densities, size, "o-", color="C2")
axes[1].set(xlabel="cells a triangle", ylabel="bytes a triangle")
plt.show()

# %% [markdown]
# ## Build time and query time
# `wrt bench queries` measures build time, query time and memory, and checks every hit: `differ` and `wrong` must be 0. The mesh is the
# pot alone.

# %%
report = run(Queries((*STRUCTURES, "bvh8"), (pot,), ("diffuse",), number=RAYS, runs=7))
assert all(row.differ == row.wrong == 0 for row in report)
report

# %% [markdown]
# The more rays, the more a slow build can pay. Each line is the time to build plus the time to trace that number of rays. The lowest line
# at a number of rays is the best structure for it.

# %%
(brute,) = run(Queries(("brute_force",), (pot,), ("diffuse",), number=RAYS // 20, runs=3))
rays = np.geomspace(1, 1e8, 200)
fig, ax = plt.subplots(figsize=(6.4, 3.6), dpi=80, layout="constrained")
for row in (*report, brute):
    seconds = np.median(row.build) + rays * np.median(row.seconds) / row.rays
    ax.loglog(rays, seconds, label=row.name, linewidth=1.8)
ax.axvline(640 * 360, color="0.7", linewidth=1)
ax.text(640 * 360 * 1.2, ax.get_ylim()[0] * 1.5, "one ray a pixel\nof 640x360", color="0.4", fontsize=9)
ax.set(xlabel="rays", ylabel="seconds to build and trace")
ax.legend()
plt.show()

for row in report:
    saved = np.median(brute.seconds) / brute.rays - np.median(row.seconds) / row.rays
    print(f"{row.name:7} has paid for itself after {max(np.median(row.build) - np.median(brute.build), 0) / saved:6.0f} rays")

# %% [markdown]
# ## Which tree?
# A BVH can be built in many ways. The surface area heuristic (SAH) predicts the number of steps of a random line through the root's box,
# if no hit stops the line. The line meets a node with the probability (area of the node's box) / (area of the root's box). So a builder
# divides a node of the area $A$ where this cost is lowest:
#
# $$ c_{node} + c_{triangle}\,\frac{A_1 N_1 + A_2 N_2}{A} $$
#
# for children of the areas $A_i$ with $N_i$ triangles. If a leaf, $c_{triangle}\,(N_1 + N_2)$, costs less, it makes a leaf. The plot
# compares six builders over the stadium with its pot: the prediction, and the measured steps of random lines and of the picture's rays.

# %%
BUILDERS = ("lbvh", "binned") if QUICK else ("lbvh", "median", "binned", "sweep", "sbvh", "reinsertion")
lines = ray_sets(wrt.build(stadium), RAYS)["random"]
table = {}
maps = {}
for builder in BUILDERS:
    tree = wrt.build(stadium, "bvh2", builder=builder)
    picture, _ = steps(tree)
    c = tree.closest_hit(lines.origins, lines.directions, counters=True).counters
    table[builder] = np.array([tree.stats.sah_cost, (c.nodes + c.primitives).mean(), picture.mean()])
    maps[builder] = picture.reshape(half[::-1])
    print(f"{builder:12} built in {tree.stats.build_seconds:5.2f} s")

fig, ax = plt.subplots(figsize=(7.2, 3.4), dpi=80, layout="constrained")
labels = ("random lines, predicted steps (SAH)", "random lines, measured steps", "the picture's rays, measured steps")
for i, label in enumerate(labels):
    values = [table[builder][i] for builder in BUILDERS]
    bars = ax.bar(np.arange(len(BUILDERS)) + 0.27 * (i - 1), np.array(values) / table["binned"][i], 0.27, label=label)
    ax.bar_label(bars, [f"{value:.3g}" for value in values], fontsize=8, padding=1)
ax.set_xticks(np.arange(len(BUILDERS)), BUILDERS)
ax.set(ylabel="relative to binned")
ax.margins(y=0.25)
ax.legend(loc="upper right", fontsize=9)
plt.show()

# %% [markdown]
# The measured lines stop at their first hit, so they take fewer steps than predicted, but they rank the builders in almost the same
# order. The picture's rays go to the pot and not all over the stadium; their ranking is similar. Two builders ignore areas: `lbvh`
# (Morton codes) and `median`. Their picture rays take about twice as many steps, because they split the pot by the count of triangles or
# at a grid of powers of two, and boxes overlap. The maps show where.

# %%
wrt.side_by_side({builder: heatmap(maps[builder], "steps of a ray", top=80.0) for builder in ("lbvh", "binned")})

# %% [markdown]
# ## Exercises
# **1.** Put two pots into the stadium, far from each other. How many steps does the grid need now? How many would it need with a second
# grid inside each full cell?
# <details><summary>Solution</summary>
#
# With a second pot 100 units away, the picture's rays take 4,318 steps instead of 7,206: the number of cells grows with the number of
# triangles, but each pot is still in a few cells. With a grid inside each full cell, a ray crosses the few cells to the pot, and then
# takes about the 22 steps of the pot alone.
# </details>
#
# **2.** Which structures can follow moving vertices (`accel.refit`)? Twist the pot by a full turn, refit, and compare the steps with those
# of a new tree.
# <details><summary>Solution</summary>
#
# All BVHs. [build_costs](build_costs.ipynb) twists the pot, and draws the growing SAH cost and the steps of both trees. Grid, octree, k-d
# tree and BSP tree must be built anew.
# </details>
#
# **3.** `wrt.build(stadium, "bvh8c")` takes about half of the memory. How many more steps does it take, and how much more time?
# <details><summary>Solution</summary>
#
# The memory is 57 % of that of `bvh8`. The picture's rays take 14.1 steps instead of 12.0, because boxes with planes of 8 bits are larger.
# `python -m wrt bench queries bvh8 bvh8c` measures the time on your machine.
# </details>
#
# **4.** From which number of rays on is building and querying a k-d tree faster than `bvh2`, if ever?
# <details><summary>Solution</summary>
#
# Never for this mesh: the line of the k-d tree lies above that of `bvh2` at every number of rays, since both its build and its rays take
# longer. In architectural models its rays can be faster (`docs/acceleration.md`).
# </details>
