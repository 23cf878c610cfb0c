# %% [markdown]
# # One ray through each structure
# An acceleration structure divides either the space (grid, octree, k-d tree, BSP tree) or the objects (BVH, bounding volume hierarchy). A
# ray *walks* through its parts, from near to far, and tests the triangles in them. This notebook draws the parts, and every step of a
# walk. `wrt.walk` records the steps in the kernels that also trace all other rays.
#
# If the environment variable `WRT_QUICK` is set, there are fewer rays. The outputs below were made without it. Lengths are in the scene's
# own unit; $t$ is the distance along the ray, because directions here have length 1.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench.rays import ray_sets, terrain
from wrt.lab.walk.walk import Section
from wrt.renderer.inspector.section import Plane, cut
from wrt.scene.shapes import merged, quad, teapot

QUICK = "WRT_QUICK" in os.environ
SIZE, RAYS, FAN = ((160, 90), 500, 20) if QUICK else ((400, 225), 5_000, 150)
rng = np.random.default_rng(4)

# %% [markdown]
# ## Pillars from above
# The mesh is a set of upright pillars without tops. Seen from above, everything is two-dimensional: a triangle is a line, a box is a
# rectangle. The ray runs to the upper right.

# %%
def pillar(center, radius, sides):
    angle = 2 * np.pi * (np.arange(sides) + rng.random()) / sides
    ring = np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], axis=1)
    points = np.concatenate([np.c_[ring, np.full(sides, z)] for z in (-0.05, 0.05)])
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    return wrt.Mesh(points, np.concatenate([np.stack([i, j, j + sides], axis=1), np.stack([i, j + sides, i + sides], axis=1)]))


origin, direction = np.array([-0.35, 0.25, 0.013]), np.array([1.0, 0.42, 0.0]) / np.hypot(1.0, 0.42)
places = [(np.array([3.4, 1.75]), 0.2)]
while len(places) < 16:
    center, radius = rng.uniform((0, 0), (4, 2.3)), rng.uniform(0.05, 0.2)
    beside = center - origin[:2] - ((center - origin[:2]) @ direction[:2]) * direction[:2]
    if all(np.hypot(*(center - c)) > radius + r + 0.05 for c, r in places) and np.hypot(*beside) > radius + 0.03:
        places.append((center, radius))
mesh = merged([pillar(center, radius, rng.integers(3, 8)) for center, radius in places], "pillars")

STRUCTURES = ("grid", "octree", "kdtree", "bsp", "bvh2", "bvh8")
walks = {name: wrt.walk(wrt.build(mesh, name), origin, direction) for name in STRUCTURES}
print(walks["octree"])

# %% [markdown]
# Each line is a step. Indents show the depth in the tree. A node is fetched, the regions of its children are tested, the nearest entered
# child is next, and the others wait on the *stack*. A waiting child is dropped if the ray already has a closer hit.
#
# ## Cells, planes and boxes
# Grey: the parts that any of many rays visits. Green: the parts that this ray enters. Red, dashed: the parts that it tests but does not
# enter. Thick black: the triangles that it tests. In the grid, numbers count the cells on the way.

# %%
WINDOW = (-0.5, 4.4, -0.3, 2.6)
above = Section(Plane(np.array([0.0, 0.0, 0.013]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])), 1.0, WINDOW)
triangles = mesh.vertices.astype(float)[mesh.faces]
sections = [cut(corners[None], above.plane) for corners in triangles]  # a line for each triangle that the plane crosses


def outline(ax, region, **style):
    corners = above.outline(region)
    if len(corners) > 1:
        ax.fill(*corners.T, fill=False, **style)


def parts(walk):
    """Return (region, step) for each part that a walk tests or visits."""
    return [(region, step) for region, step in zip(walk.regions, walk.steps, strict=True) if region is not None]


def fan(accel):
    """Return walks of many rays in the plane of the drawing."""
    for _ in range(FAN):
        angle, start = rng.uniform(0, 2 * np.pi), rng.uniform((0, 0), (4, 2.3))
        yield wrt.walk(accel, [*start, 0.013], [np.cos(angle), np.sin(angle), 0])


fig, axes = plt.subplots(3, 2, figsize=(10.4, 9.6), dpi=80, layout="constrained")
first = None
for ax, (name, walk) in zip(axes.flat, walks.items(), strict=True):
    accel = wrt.build(mesh, name)
    known = {}
    for each in fan(accel):
        known |= {(step.index, step.count): region for region, step in parts(each) if step.kind != "plane"}
    for region in known.values():
        outline(ax, region, ec="0.8", lw=0.7)
    for region, step in parts(walk):
        if step.result == "missed":
            outline(ax, region, ec="tab:red", lw=1.0, ls="--")
    number = 0
    for region, step in parts(walk):
        if step.kind in ("node", "leaf", "cell") and step.result != "missed":
            outline(ax, region, ec="tab:green", lw=1.4)
        if step.kind == "cell" and name == "grid":
            corners = above.outline(region)
            if len(corners) and np.ptp(corners, axis=0).max() < 3:
                number += 1
                ax.text(*corners.mean(axis=0), str(number), fontsize=7, color="tab:green", ha="center", va="center")
    tested = [step.prim_id for step in walk.steps if step.prim_id >= 0]
    for i, (ends,) in ((i, lines) for i, lines in enumerate(sections) if len(lines)):
        ax.plot(*ends.T, color="black" if i in tested else "0.55", lw=2.2 if i in tested else 1.0)
    hits = accel.closest_hit(origin[None], direction[None], counters=True)
    counts = {key: int(getattr(hits.counters, key)[0]) for key in ("nodes", "boxes", "primitives", "pushes", "pops", "leaves")}
    assert all(walk.counts[key] == value for key, value in counts.items())  # the walk is the ray that the counters count
    first = first or (hits.prim_id[0], hits.t[0])
    assert (hits.prim_id[0], hits.t[0]) == first  # the same hit to the last bit
    ax.annotate("", (origin + hits.t[0] * direction)[:2], origin[:2], arrowprops={"arrowstyle": "->", "color": "tab:orange", "lw": 1.6})
    ax.set(xlim=WINDOW[:2], ylim=WINDOW[2:], aspect="equal", xlabel="x, units", ylabel="y, units")
    ax.set_title(f"{name}: {counts['nodes']} nodes, {counts['boxes']} boxes, {counts['primitives']} triangles", fontsize=10)
plt.show()

# %% [markdown]
# - **Grid**: all cells are equal. The ray goes from cell to neighbouring cell, through empty ones, too.
# - **Octree**: a cell is cut into eight equal parts (four, seen from above) while it has many triangles. Empty space costs few steps. The
#   signs of the direction give the order of the parts from near to far.
# - **k-d tree**: a plane at right angles to an axis cuts each cell where this makes random rays cheapest. The side from which the ray comes
#   is visited first.
# - **BSP tree** (binary space partitioning): the planes have any orientation. They are planes of the triangles themselves, so that cells
#   fit the pillars; but every plane test costs more. The order is that of the k-d tree.
# - **BVH**: boxes surround groups of triangles. Boxes may overlap, each triangle is in one leaf, and empty space is in no box. `bvh2` has
#   two children per node, `bvh8` eight: fewer nodes, about as many box tests. The box that the ray enters first is visited first.
#
# ## Step by step
# `walk.draw(step=...)` draws the walk up to a step, `walk.save("walk.gif")` an animation of all. Its horizontal axis is the ray itself,
# so that distances along the ray are exact. The plane of the drawing is upright here and cuts hills. Blue parts wait on the stack.

# %%
def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


walk = wrt.walk(wrt.build(terrain(12), "bvh2"), [-1.3, 0.5, -0.75], unit([0.85, -0.2, 0.5]))
shown = [i for i, step in enumerate(walk.steps) if step.kind in ("node", "leaf") or step.result == "closest hit"]
chosen = [shown[round(k)] for k in np.linspace(0, len(shown) - 1, 6)]
fig, axes = plt.subplots(3, 2, figsize=(10.4, 10.0), dpi=80, layout="constrained")
for ax, step in zip(axes.flat, chosen, strict=True):
    walk.draw(ax, step)
plt.show()
depths = [len(step.stack) for step in walk.steps]
assert max(depths) == walk.counts["stack"]
print(f"{len(walk)} steps; largest stack: {max(depths)}")

# %% [markdown]
# ## The walk through a grid by hand
# Along each axis, a ray crosses the planes between cells at equal steps of $t$. So the next cell follows from the smallest of three
# numbers, without a division (Amanatides and Woo 1987). The cell checks the formula against the walk of wrt.

# %%
def cells_of(o, d, low, width, n):
    """Yield the cells (x, y, z) that a ray crosses, and the t at which it enters each."""
    with np.errstate(divide="ignore", invalid="ignore"):
        enter = np.minimum((low - o) / d, (low + n * width - o) / d)
        t = max(0.0, np.nanmax(np.where(d == 0, -np.inf, enter)))
        cell = np.clip(np.floor((o + t * d - low) / width), 0, n - 1).astype(int)
        following = np.where(d == 0, np.inf, (low + (cell + (d > 0)) * width - o) / d)  # t of the next plane along each axis
        step = np.where(d == 0, np.inf, np.abs(width / d))
    while True:
        yield tuple(cell.tolist()), t
        axis = np.argmin(following)
        t = following[axis]
        cell[axis] += np.sign(d[axis]).astype(int)
        if not 0 <= cell[axis] < n[axis]:
            return
        following[axis] += step[axis]


grid = wrt.build(mesh, "grid")
n = np.array(grid.built.arrays["n"]).reshape(-1)[:3].astype(int)
whole = walks["grid"].regions[0]
high, low = -whole.offsets[:3], whole.offsets[3:]
mine = list(cells_of(origin, direction, low, (high - low) / n, n))
theirs = [step for step in walks["grid"].steps if step.kind == "cell"][1:]
print(f"{n[0]} x {n[1]} x {n[2]} cells, on the way: {len(mine)}, until the hit: {len(theirs)}")
assert all(abs(t - step.t) < 1e-5 for (_, t), step in zip(mine, theirs, strict=False)) and len(theirs) <= len(mine)

# %% [markdown]
# ## The segment of a ray
# A ray has a segment $[t_{min}, t_{max}]$; hits outside of it do not count. This is needed twice:
# - **A shadow ray ends at its light.** With $d = $ light $-$ point, the light is at $t = 1$. A wall *behind* the lamp must not cast a
#   shadow: $t_{max} = 1$.
# - **A ray does not hit what it starts on.** $t_{min} > 0$ excludes the surface at the origin. How large must it be? See
#   [whitted](whitted.ipynb).
#
# The segment also saves work. The walk tests no part that begins behind $t_{max}$. And each hit *shortens* the segment to its $t$, so that
# everything behind it is skipped.

# %%
hills = terrain(40 if QUICK else 120)
accel = wrt.build(hills, "bvh2")
light = np.array([1.3, 0.45, 0.2])
rays = ray_sets(accel, RAYS)["primary"]
seen = accel.closest_hit(rays.origins, rays.directions)
points = (seen.point + np.sign((seen.normal * (light - seen.point)).sum(axis=1, keepdims=True)) * 1e-4 * seen.normal)[seen.prim_id >= 0]
to_light = (light - points).astype(np.float32)
dome = merged([hills, quad((-500, 1.5, 500), (1000, 0, 0), (0, 0, -1000))], "hills under a ceiling")
room = wrt.build(dome, "bvh2")
short, long = (room.any_hit(points, to_light, t_max=t_max) for t_max in (1.0, np.inf))
print(f"hills under a ceiling above the lamp: in shadow {short.mean():.1%} with t_max = 1, {long.mean():.1%} without")
assert long[to_light[:, 1] > 0.01].all() and short.any() and short.mean() < 0.5

# %%
longest = np.ptp(hills.vertices, axis=0).max()
diffuse = ray_sets(accel, RAYS)["diffuse"]  # from the surface into random directions
free = accel.closest_hit(diffuse.origins, unit(diffuse.directions))
limits, nodes = longest * np.geomspace(0.002, 2, 12), {name: [] for name in ("grid", "bvh2")}
for name in nodes:
    tested = wrt.build(hills, name)
    for t_max in limits:
        hits = tested.closest_hit(diffuse.origins, unit(diffuse.directions), t_max=t_max, counters=True)
        assert (hits.prim_id == np.where(free.t <= t_max, free.prim_id, -1)).all()  # the segment is a filter, nothing else
        nodes[name].append(hits.counters.nodes.mean() + hits.counters.primitives.mean())
fig, ax = plt.subplots(figsize=(6.4, 3.0), dpi=80, layout="constrained")
for name, values in nodes.items():
    ax.plot(limits, values, "o-", label=name)
ax.set(xscale="log", xlabel="t_max, units (the hills are 2 wide)", ylabel="nodes + triangles per ray", ylim=(0, None))
ax.legend()
plt.show()

# %% [markdown]
# The shortest rays cost a third of the longest in the grid, and two thirds in the tree: a tree descends from its root even for the
# shortest ray, a grid begins in the cell of the origin.
#
# ## Boxes over a picture
# The same parts in three dimensions: the walks of a picture's rays collect all boxes and cells, which are drawn over the picture down to
# a depth.

# %%
pot = teapot(20)
camera = wrt.Camera.look_at((1.6, 1.3, 2.4), (0.05, 0.4, 0.0), fov_y=np.radians(32))
o, d = wrt.camera_rays(camera, SIZE)
frame = camera.camera_to_world


def pixels_of(points):
    """Project points (N, 3) to pixels."""
    local = (points - frame[:3, 3]) @ frame[:3, :3]
    tan = np.tan(camera.fov_y / 2)
    x, y = local[:, 0] / -local[:, 2] / (tan * SIZE[0] / SIZE[1]), local[:, 1] / -local[:, 2] / tan
    return np.stack([(x + 1) / 2 * SIZE[0], (1 - y) / 2 * SIZE[1]], axis=1)


def bounds(region):
    """Return the lowest and the highest corner of a box or of a cell with planes at right angles to the axes."""
    sides = [(region.offsets[np.abs(region.normals - sign * np.eye(3)[axis]).max(axis=1) < 1e-9] * -sign)
             for sign in (1, -1) for axis in range(3)]
    return np.array([side.max() for side in sides[3:]]), np.array([side.min() for side in sides[:3]])


shaded = wrt.build(pot).closest_hit(o, d)
light = np.array([0.4, 0.7, 0.6]) / np.linalg.norm([0.4, 0.7, 0.6])
grey = np.where(shaded.prim_id >= 0, 0.25 + 0.7 * np.abs(np.nan_to_num(shaded.normal) @ light), 1.0).reshape(SIZE[::-1])
EDGES = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]
fig, axes = plt.subplots(2, 2, figsize=(10.4, 6.2), dpi=80, layout="constrained")
for ax, (name, depth) in zip(axes.flat, (("bvh2", 3), ("bvh2", 6), ("octree", 4), ("kdtree", 7)), strict=True):
    accel, boxes = wrt.build(pot, name), {}
    for i in rng.choice(np.flatnonzero(shaded.prim_id >= 0), 2 * FAN):
        walk = wrt.walk(accel, o[i], d[i])
        for region, step in parts(walk):
            if step.kind == "node" and step.depth == depth:
                boxes[step.index] = bounds(region)
    lowest, highest = pot.vertices.min(axis=0), pot.vertices.max(axis=0)
    assert all((low > lowest - 1e-5).all() and (high < highest + 1e-5).all() and (low <= high).all() for low, high in boxes.values())
    ax.imshow(grey, cmap="gray", vmin=0, vmax=1)
    for k, box in enumerate(boxes.values()):
        corners = pixels_of(np.array([[box[i >> axis & 1][axis] for axis in range(3)] for i in range(8)]))
        for a, b in EDGES:
            ax.plot(*corners[[a, b]].T, color=plt.get_cmap("turbo")(k / max(len(boxes) - 1, 1)), lw=0.9)
    ax.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0), xticks=[], yticks=[])
    ax.set_title(f"{name}, depth {depth}: {len(boxes)} nodes that rays visit", fontsize=10)
plt.show()

# %% [markdown]
# Boxes of the BVH fit the handle and the spout. Cells of octree and k-d tree fill the whole box; only those on the way of a ray to the
# surface are shown.
#
# ## Exercises
# **1.** A grid has $n$ cells along each of three axes. How many cells does a ray cross at most?
# <details><summary>Solution</summary>
#
# It crosses at most $n - 1$ inner planes of each axis, and each crossing enters one cell: $1 + 3(n-1) = 3n - 2$. `len(mine)` above obeys
# this with the three numbers of cells: $n_x + n_y + n_z - 2$.
# </details>
#
# **2.** Why may a ray stop at its first hit in a grid, but not always in a BVH?
# <details><summary>Solution</summary>
#
# Cells do not overlap and are visited from near to far: a hit *inside the cell* is before all later cells. (A hit of a triangle that
# reaches beyond its cell may lie behind another triangle of a later cell, so it must lie in the cell.) Boxes of a BVH overlap: a box that
# begins later may have the closer hit. The ray stops when all waiting boxes begin behind the hit.
# </details>
#
# **3.** In which structures can one ray test the same triangle twice, and what helps?
# <details><summary>Solution</summary>
#
# In those that divide space: a triangle lies in all cells that it touches. A *mailbox* remembers the triangles tested last
# (`wrt.build(mesh, "grid", mailbox=True)`; the walk then has steps "skip"). In a BVH each triangle is in one leaf, except after spatial
# splits.
# </details>
#
# **4.** Let the ray above begin at its hit and go back. Does it visit the same cells of the grid?
# <details><summary>Solution</summary>
#
# `wrt.walk(grid, origin + t * direction, -direction, t_min=1e-4)` visits them in the reverse order, and continues beyond the old origin if
# that lies inside the grid: the segment decides where a ray ends, not where another ray began.
# </details>
