# %% [markdown]
# # Inside the RT core: counters, heat maps, what if
# An RT core has a unit that tests boxes, a unit that tests triangles, and a unit that walks a hierarchy of boxes with them. wrt's
# kernels have the same split, and can count what each unit does. Here the counts of a picture are looked at ray by ray; a model
# turns them into rays a second; and then the design is changed.
#
# The model, its parameters and their sources: `docs/rt_core.md`. Its results are for comparing designs. Rates and node format of
# real RT cores were never published: absolute numbers are good to a factor of 2 at best.
#
# With `WRT_QUICK` in the environment, pictures are smaller and rays fewer; the outputs below are of the full setting.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench.visibility import terrain
from wrt.lab.rtcore import whatif
from wrt.lab.rtcore.model import TERMS
from wrt.lab.rtcore.parameters import BASE, GPUS
from wrt.lab.rtcore.profile_report import model_rows
from wrt.lab.rtcore.profiler import KINDS
from wrt.picture.heatmap import heatmap
from wrt.scene.shapes import teapot, torus

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP, RAYS = ((160, 90), 1, 1024) if QUICK else ((480, 270), 32, 16384)

# %% [markdown]
# A pot of cut glass and a mirror ring on the checkerboard of `scenes/whitted.toml`, without vertex normals, so that each facet
# reflects and refracts by itself.

# %%
balls = wrt.load_scene("../scenes/whitted.toml")
glass, mirror, paint = (sphere.material for sphere in balls.spheres)
pot, ring = (replace(mesh, normals=None) for mesh in (teapot(28), torus(0.62, 0.26, 40, 20)))
on_the_left, on_the_right = np.diag([1.75, 1.75, 1.75, 1.0]), np.eye(4)
on_the_left[:3, 3], on_the_right[:3, 3] = (-0.75, 0.0, 2.3), (2.0, 0.3, 2.0)
objects = wrt.Object(pot, (glass,), transform=on_the_left), wrt.Object(ring, (mirror,), transform=on_the_right)
spheres = balls.spheres[1], replace(balls.spheres[2], center=(2.0, 0.42, 2.0))
scene = replace(balls, name="a pot of cut glass", objects=(*balls.objects, *objects), spheres=spheres)
wrt.side_by_side({"": wrt.render(scene, size=SIZE, spp=SPP)})

# %% [markdown]
# ## What does a pixel cost?
# `wrt.profile` traces the same rays as a render does, with the counters compiled in: without them the machine code holds no trace
# of counting. Nodes have two children here; how many Turing's have was not published. Rays of every kind at every depth (bounces
# behind them), with what they cost together:

# %%
profile = wrt.profile(scene, size=SIZE, spp=1, accel="bvh2")
profile

# %% [markdown]
# One sample of a pixel is a tree of rays: a matte hit sends a shadow ray to each light that it faces, a mirror one ray on, glass
# two. So the glass pot takes most rays, and the sky one a pixel.

# %%
profile.heatmap("probes")

# %% [markdown]
# The nodes that these rays fetch: rays among the facets cost more each, so that this map has more contrast than that of the rays.

# %%
profile.heatmap("nodes")

# %% [markdown]
# The stack shows the boxes themselves: the children that wait are boxes that the ray meets, and their outlines are on the sky and
# on the floor.

# %%
profile.heatmap("stack")

# %% [markdown]
# What a ray costs by itself depends on where it starts. Many rays from the eye see sky or floor; one that is reflected or
# refracted starts among the facets, and fetches about three times the nodes (means in the legend).

# %%
rays = profile.rays
per_ray = rays.counts["nodes"]
fig, ax = plt.subplots(figsize=(6.4, 3.2), dpi=80, layout="constrained")
edges = np.arange(0, per_ray.max() + 3, 2) - 0.5
for i, kind in enumerate(KINDS):
    chosen = per_ray[rays.kind == i]
    if len(chosen):
        ax.stairs(np.histogram(chosen, edges)[0] / len(chosen), edges, label=f"{kind}, mean {chosen.mean():.2f}", linewidth=1.8)
ax.set(xlabel="nodes that a ray fetches", ylabel="share of the rays", xlim=(0, np.percentile(per_ray, 99.8)), yscale="log")
ax.legend(title="kind of ray")
plt.show()

# %% [markdown]
# ## From counts to clocks
# A ray takes of an RT core at least what its boxes take of the box unit, its triangles of the triangle unit, its cache lines of
# the L1, what misses there of the L2, and so on; and it waits for its longest chain of fetches and tests, over as many warps as
# wait at the same time. These overlap, so that **the largest term decides**: a roofline. What misses the caches is simulated,
# with the addresses that the rays fetched.

# %%
gpu = GPUS["rtx2080ti"]
rows = model_rows(profile, gpu)
rows

# %%
fig, ax = plt.subplots(figsize=(6.4, 3.4), dpi=80, layout="constrained")
height = 0.8 / len(rows)
for i, row in enumerate(rows):
    y = np.arange(len(TERMS)) + (i - 0.5 * (len(rows) - 1)) * height
    ax.barh(y, [row.clocks[name] for name in TERMS], height, label=f"{row.name}: {row.rays_per_second / 1e9:.1f} Grays/s")
ax.set_yticks(np.arange(len(TERMS)), TERMS)
ax.invert_yaxis()
ax.set(xlabel=f"clocks a ray and RT core ({BASE.boxes:g} boxes or {BASE.triangles:g} triangle a clock, {BASE.warps} warps)")
ax.legend(title="the longest bar of a colour decides")
plt.show()

# %% [markdown]
# Latency decides for every kind of ray: with four warps at a time, the core mostly waits. And lanes wait for each other: of
# shadow rays as they come, three quarters of the lanes' time is lost (SIMT efficiency), since the pixels of a warp have different
# numbers of them.
#
# What of this is assumed, and how much hangs on it? Each assumption is swept alone; the bar is the factor from the least to the
# most rays a second.

# %%
by_name = {row.name: row for row in rows}
most = max(max(by_name[name].factors.values()) for name in ("primary", "secondary"))
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.0), dpi=80, layout="constrained", sharex=True)
for ax, name in zip(axes, ("primary", "secondary"), strict=True):
    factors = by_name[name].factors
    ax.barh(list(factors), list(factors.values()), color="C0" if name == "primary" else "C1")
    ax.invert_yaxis()
    ax.set(title=f"{name} rays", xlabel="most over least", xlim=(1.0, 1.05 * most))
plt.show()

# %% [markdown]
# ## What if?
# One thing of the design is changed, the same rays are counted again. Hills of 20,000 triangles, with rays that start on them
# into all directions (diffuse): incoherent, as after a first bounce.

# %%
hills = terrain(100)
camera = wrt.Camera.look_at((0.0, 1.1, 1.9), (0.0, -0.15, 0.0), fov_y=np.radians(50))
counters = wrt.build(hills, "bvh2").closest_hit(*wrt.camera_rays(camera, SIZE), counters=True).counters
wrt.side_by_side({"": heatmap(counters.nodes.reshape(SIZE[::-1]), "the hills: nodes that the ray of each pixel fetches")})

# %%
def study(name, kinds=("diffuse",)):
    rows = whatif.run(whatif.Plan(name, hills, kinds, RAYS))
    assert all(row.differ == 0 for row in rows)  # a design may cost more; it may not find other hits
    return rows


# %% [markdown]
# **How wide is a node, and in which format?** `bvh8c` holds eight boxes with planes of 8 bits; spheres and 14-DOPs bound
# otherwise.

# %%
study("width")

# %% [markdown]
# Wider nodes: fewer fetches, one after another, about as many boxes, and more triangles. Where latency decides (4 warps), that
# pays; where it is hidden (32 warps), lines and bytes count, and eight children gain nothing over four. Planes of 8 bits nearly
# halve the bytes of `bvh8` for 2 % more boxes. Spheres fit so badly that rays test 1.7 times as many; 14-DOPs fit best, and are
# too large.

# %% [markdown]
# **How many entries has the stack?** A short one that overflows forgets its oldest entry. When it runs out, the walk starts again
# at the root, and follows a trail of one bit a level to where it was.

# %%
stack = study("stack")
stack

# %% [markdown]
# **How many bits has a plane of a box?** Fewer make nodes smaller and boxes larger (they are rounded outwards: no ray may be
# lost).

# %%
planes = study("planes")
planes

# %%
fig, axes = plt.subplots(1, 2, figsize=(7.4, 2.8), dpi=80, layout="constrained")
axes[0].plot([row.variant for row in stack], [row.nodes for row in stack], "o-")
axes[0].set(title="stack", ylabel="nodes a ray")
axes[1].plot([row.variant for row in planes], [row.nodes / planes[0].nodes for row in planes], "o-", label="nodes a ray")
axes[1].plot([row.variant for row in planes], [row.bytes / planes[0].bytes for row in planes], "s-", label="bytes a ray")
axes[1].set(title="planes of boxes", ylabel="relative to fp32", ylim=(0, None))
axes[1].legend()
for ax in axes:
    ax.tick_params(axis="x", labelrotation=30)
plt.show()

# %% [markdown]
# Four entries are nearly as good as any number, and without a stack a ray fetches twice the nodes. Planes of 8 or 6 bits fetch
# least; at 4 bits the boxes have grown so much that what is saved on a node goes into more nodes.

# %% [markdown]
# **What are the order of children and the early stop worth?** A ray that visits the nearer child first finds its hit soon, and
# need not look behind it.

# %%
study("order", ("primary", "diffuse"))

# %% [markdown]
# For primary rays each by itself is worth next to nothing, and both together a third of the nodes: order finds the hit early, and
# only the early stop makes use of that. Who never stops visits the same nodes in any order. Diffuse rays gain less: most leave
# for the sky, and there is nothing to stop at.

# %% [markdown]
# **What is sorting worth?** The same rays as the picture makes them, sorted by origin and direction, and shuffled. The work is
# the same; what changes is what the lanes of a warp share.

# %%
study("sorting")

# %% [markdown]
# Nodes and triangles a ray are the same to the last digit; lines double when the rays are shuffled, and where latency is hidden
# that costs more than half of the speed. As they come, these rays are sorted already, by where they start: sorting by direction
# as well helps the lanes (SIMT) and hurts the lines.

# %% [markdown]
# ## Box unit against triangle unit
# How many boxes and triangles a clock should an RT core test? A map over both rates, with latency hidden (32 warps) and a warm
# L2.

# %%
rates = [rate for rate in whatif.run(whatif.Plan("rates", hills, ("diffuse",), RAYS)) if rate.structure in ("bvh2", "bvh8")]
fastest = max(rate.rays_per_second for rate in rates)
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.0), dpi=80, layout="constrained")
for ax, structure in zip(axes, ("bvh2", "bvh8"), strict=True):
    mine = [rate for rate in rates if rate.structure == structure]
    boxes, triangles = sorted({rate.boxes for rate in mine}), sorted({rate.triangles for rate in mine})
    at = {(rate.boxes, rate.triangles): rate for rate in mine}
    speeds = [[at[b, t].rays_per_second for b in boxes] for t in triangles]
    ax.imshow(speeds, origin="lower", cmap="Blues", vmin=0, vmax=2 * fastest, aspect="auto")
    for x, b in enumerate(boxes):
        for y, t in enumerate(triangles):
            ax.text(x, y, f"{speeds[y][x] / 1e9:.1f}\n{at[b, t].limit}", ha="center", va="center", fontsize=9)
    ax.set(title=f"{structure}: Grays/s, and what limits", xlabel="boxes a clock", ylabel="triangles a clock",
           xticks=range(len(boxes)), xticklabels=[f"{b:g}" for b in boxes],
           yticks=range(len(triangles)), yticklabels=[f"{t:g}" for t in triangles])
plt.show()

# %% [markdown]
# With two children a node, no triangle rate limits: boxes do, and from 4 a clock on the L2. With eight there are more triangles a
# ray, and half a triangle a clock would be too few. Twice the triangle rate pays only where triangles are what limits.

# %% [markdown]
# ## Exercises
# 1. Let the pot be a mirror. Which heat map changes most, and what happens to the range of the model?
# 2. Which kind of ray is the hardest for the caches?
#    `wrt.lab.rtcore.profile_report.work_of(profile, "shadow").misses(gpu, BASE)` tells.
# 3. `study("order")` with hills seen from above has little depth. Build a mesh with much (several `terrain`s above each other, by
#    `wrt.Mesh`), and look at what order and early stop save.
# 4. Later RT cores than Turing's test triangles at twice the rate. For which structure and rays does the model agree that it
#    pays? The study "rates" tells (`doubled`).
