# %% [markdown]
# # Inside the RT core: counters, heat maps, what if
# An RT core (ray tracing core of a GPU) has three units. One tests boxes, one tests triangles, and one traverses a hierarchy of boxes.
# wrt's kernels have the same units, and can count the work of each. This notebook shows the counts of a picture's rays. Then a model
# turns them into rays per second, and the design of the RT core is varied.
#
# `docs/rt_core.md` describes the model, its parameters and their sources. Use its results to compare designs. NVIDIA has not published
# the rates and the node format of RT cores, so absolute numbers are accurate to a factor of 2 at best.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller and rays fewer. The outputs below were made without it.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench.rays import ray_sets, terrain
from wrt.lab.rtcore import whatif
from wrt.lab.rtcore.meshes import in_warps
from wrt.lab.rtcore.model import TERMS, predict, trace_rays
from wrt.lab.rtcore.parameters import BASE, GPUS, SWEEPS
from wrt.lab.rtcore.profile_report import model_rows
from wrt.lab.rtcore.profiler import KINDS
from wrt.picture.heatmap import heatmap
from wrt.scene.shapes import teapot, torus

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP, RAYS = ((160, 90), 1, 1024) if QUICK else ((480, 270), 32, 16384)

# %% [markdown]
# The scene is a glass pot and a mirror ring on the checkerboard of `scenes/whitted.toml`. Both meshes have no vertex normals, so that
# each facet reflects and refracts like cut glass.

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
# `wrt.profile` traces the same rays as a render, with counters in the kernel. Nodes have two children here; how many the nodes of Turing
# (NVIDIA's first GPUs with RT cores) have is not published. The table has one row for each kind of ray and each depth (number of bounces
# before the ray), with the total cost of these rays:

# %%
profile = wrt.profile(scene, size=SIZE, spp=1, accel="bvh2")
profile

# %% [markdown]
# One sample of a pixel is a tree of rays. A hit on a matte surface sends a shadow ray to each light that it faces. A mirror sends one
# reflected ray, and glass sends a reflected and a refracted ray. So the glass pot has the most rays, and the sky has one per pixel. The
# heat map "probes" shows the number of rays of each pixel.

# %%
profile.heatmap("probes")

# %% [markdown]
# The next heat map shows the nodes that these rays fetch. Each ray between the facets costs more than others, so this map has more
# contrast than the map of rays.

# %%
profile.heatmap("nodes")

# %% [markdown]
# The map of the stack shows outlines of boxes on the sky and on the floor. The reason: a stack entry is a box that the ray meets and that
# waits for its visit.

# %%
profile.heatmap("stack")

# %% [markdown]
# The cost of a single ray depends on where it starts. Many camera rays see sky or floor. A reflected or refracted ray starts between the
# facets, and fetches about three times as many nodes (the legend has the means).

# %%
rays = profile.rays
per_ray = rays.counts["nodes"]
fig, ax = plt.subplots(figsize=(6.4, 3.2), dpi=80, layout="constrained")
edges = np.arange(0, per_ray.max() + 3, 2) - 0.5
for i, kind in enumerate(KINDS):
    chosen = per_ray[rays.kind == i]
    if len(chosen):
        ax.stairs(np.histogram(chosen, edges)[0] / len(chosen), edges, label=f"{kind}, mean {chosen.mean():.2f}", linewidth=1.8)
ax.set(xlabel="nodes that a ray fetches", ylabel="share of the rays of that kind", xlim=(0, np.percentile(per_ray, 99.8)), yscale="log")
ax.legend(title="kind of ray")
plt.show()

# %% [markdown]
# ## From counts to clock cycles
# A ray occupies the box unit for its box tests, and the triangle unit for its triangle tests. It occupies the L1 cache for its cache
# lines, the L2 cache for lines that miss the L1, and the DRAM for lines that miss the L2. It also waits for the latency of its fetches
# and tests; other warps share this time. All these terms overlap, so **the largest term decides** (a roofline model). The cache misses
# come from a simulation with the addresses that the rays fetched.

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
ax.set(xlabel=f"cycles per ray and RT core ({BASE.boxes:g} boxes or {BASE.triangles:g} triangle per cycle, {BASE.warps} warps)")
ax.legend(title="the longest bar of a colour is the limit")
plt.show()

# %% [markdown]
# Latency is the largest term for every kind of ray: with four warps at a time, the core mostly waits. Lanes also wait for each other.
# With shadow rays in pixel order, lanes are idle for three quarters of the time (SIMT efficiency), because the pixels of a warp have
# different numbers of shadow rays.
#
# How much do the assumptions matter? Each assumed parameter is varied alone. Each bar is the ratio of the most to the least rays per
# second.

# %%
by_name = {row.name: row for row in rows}
most = max(max(by_name[name].factors.values()) for name in ("primary", "secondary"))
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.0), dpi=80, layout="constrained", sharex=True)
for ax, name in zip(axes, ("primary", "secondary"), strict=True):
    factors = by_name[name].factors
    ax.barh(list(factors), list(factors.values()), color="C0" if name == "primary" else "C1")
    ax.invert_yaxis()
    ax.set(title=f"{name} rays", xlabel="most over least rays per second", xlim=(1.0, 1.05 * most))
plt.show()

# %% [markdown]
# ## What if?
# Each study changes one property of the design, and counts the same rays again. The mesh is a terrain of 20,000 triangles. Its rays start
# on the surface into random directions (diffuse): incoherent, like rays after a first bounce.

# %%
hills = terrain(100)
camera = wrt.Camera.look_at((0.0, 1.1, 1.9), (0.0, -0.15, 0.0), fov_y=np.radians(50))
counters = wrt.build(hills, "bvh2").closest_hit(*wrt.camera_rays(camera, SIZE), counters=True).counters
wrt.side_by_side({"": heatmap(counters.nodes.reshape(SIZE[::-1]), "the hills: nodes that the ray of each pixel fetches")})

# %%
def study(name, kinds=("diffuse",)):
    rows = whatif.run(whatif.Plan(name, hills, kinds, RAYS))
    assert all(row.differ == 0 for row in rows)  # a design may cost more, but must find the same hits
    return rows


# %% [markdown]
# **How many children has a node, and in which format?** `bvh8c` stores the eight boxes of `bvh8` with planes of 8 bits.

# %%
study("width")

# %% [markdown]
# Wider nodes need fewer successive fetches, about as many box tests, and more triangle tests. If latency is the limit (4 warps), that is
# faster. If latency is hidden (32 warps), cache lines and bytes are the limit, and eight children are no better than four. Planes of 8
# bits nearly halve the bytes of `bvh8`, for 2 % more box tests.

# %% [markdown]
# **How many entries has the stack?** A short stack that overflows drops its oldest entry. When the stack is empty, the traversal restarts
# at the root. A trail of one bit per level leads it back to the first node that it has not visited.

# %%
stack = study("stack")
stack

# %% [markdown]
# **How many bits has a plane of a box?** Fewer bits make nodes smaller but boxes larger, because planes are rounded outwards: no ray may
# be lost.

# %%
planes = study("planes")
planes

# %%
fig, axes = plt.subplots(1, 2, figsize=(7.4, 2.8), dpi=80, layout="constrained")
axes[0].plot([row.variant for row in stack], [row.nodes for row in stack], "o-")
axes[0].set(title="stack", ylabel="nodes per ray")
axes[1].plot([row.variant for row in planes], [row.nodes / planes[0].nodes for row in planes], "o-", label="nodes per ray")
axes[1].plot([row.variant for row in planes], [row.bytes / planes[0].bytes for row in planes], "s-", label="bytes per ray")
axes[1].set(title="planes of boxes", ylabel="relative to fp32", ylim=(0, None))
axes[1].legend()
for ax in axes:
    ax.tick_params(axis="x", labelrotation=30)
plt.show()

# %% [markdown]
# Four stack entries are nearly as good as any number. Without a stack, a ray fetches twice as many nodes. With planes of 8 or 6 bits,
# rays fetch the fewest bytes. With 4 bits the boxes are so large that more nodes are fetched, which costs the bytes that each node saves.

# %% [markdown]
# **How much do front-to-back order and early stop save?** A ray that visits the nearer child first finds its hit early. It can then skip
# boxes behind the hit.

# %%
study("order", ("primary", "diffuse"))

# %% [markdown]
# For primary rays, either alone saves almost nothing; both together save a third of the nodes. Front-to-back order finds the hit early,
# and the early stop skips what is behind it. Without the early stop, a ray visits the same nodes in any order. Diffuse rays gain less,
# because most of them reach the sky and have no hit.

# %% [markdown]
# **How much does sorting save?** The study traces the same rays in the order of the picture, sorted by origin and direction, and
# shuffled. The work of each ray is the same. Only the memory that the lanes of a warp share changes.

# %%
study("sorting")

# %% [markdown]
# The numbers of nodes and triangles per ray do not change. Shuffling doubles the number of cache lines; if latency is hidden, this costs
# more than half of the speed. In the order of the picture, these rays are already sorted by origin. Sorting by direction, too, improves
# the SIMT efficiency but needs more cache lines.

# %% [markdown]
# ## Box unit against triangle unit
# How many boxes and triangles per clock cycle should an RT core test? The maps vary both rates. Latency is hidden (32 warps), and the L2
# cache already holds the data.

# %%
def rates_of(structure):
    """Return (boxes, triangles) per clock -> prediction for diffuse rays."""
    accel = wrt.build(hills, structure)
    rays = in_warps(accel, ray_sets(accel, RAYS))["diffuse"]
    work = trace_rays(accel, structure, rays.origins, rays.directions)
    return {(boxes, triangles): predict(work, gpu, replace(whatif.MANY_WARPS, boxes=boxes, triangles=triangles))
            for boxes in SWEEPS["boxes"] for triangles in SWEEPS["triangles"]}


rates = {structure: rates_of(structure) for structure in ("bvh2", "bvh8")}
fastest = max(rate.rays_per_second for at in rates.values() for rate in at.values())
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.0), dpi=80, layout="constrained")
for ax, (structure, at) in zip(axes, rates.items(), strict=True):
    boxes, triangles = SWEEPS["boxes"], SWEEPS["triangles"]
    speeds = [[at[b, t].rays_per_second for b in boxes] for t in triangles]
    ax.imshow(speeds, origin="lower", cmap="Blues", vmin=0, vmax=2 * fastest, aspect="auto")
    for x, b in enumerate(boxes):
        for y, t in enumerate(triangles):
            ax.text(x, y, f"{speeds[y][x] / 1e9:.1f}\n{at[b, t].limit}", ha="center", va="center", fontsize=9)
    ax.set(title=f"{structure}: Grays/s, and what limits", xlabel="boxes per cycle", ylabel="triangles per cycle",
           xticks=range(len(boxes)), xticklabels=[f"{b:g}" for b in boxes],
           yticks=range(len(triangles)), yticklabels=[f"{t:g}" for t in triangles])
plt.show()

# %% [markdown]
# With two children per node, the triangle rate is never the limit. The box rate is the limit, and from 4 boxes per cycle on, the L2
# cache. With eight children, a ray tests more triangles, and half a triangle per cycle would be too few. A doubled triangle rate helps
# only if triangle tests are the limit.

# %% [markdown]
# ## Exercises
# **1.** Let the pot be a mirror. Which heat map changes most, and how does the modelled range of speeds change?
# <details><summary>Solution</summary>
#
# A mirror makes one ray per hit instead of two, and no ray bounces inside the pot. The mean number of rays of a pixel falls from 4.8 to
# 2.4, but nodes fall from 67 to 19 and triangles from 19 to 4: rays between the facets were the most expensive. The model gives 17 Grays/s
# instead of 6.6 for all rays together; the range (low and high) moves by about the same factor.
# </details>
#
# **2.** Which kind of ray has the most cache misses? Use `wrt.lab.rtcore.profile_report.work_of(profile, "shadow").misses(gpu, BASE)`.
# <details><summary>Solution</summary>
#
# Secondary rays. They miss the L1 1.2 times per ray, shadow rays 0.5 times, primary rays 0.2 times: neighbouring secondary rays fetch
# different nodes.
# </details>
#
# **3.** In `study("order")`, a ray crosses few surfaces of the hills. Build a mesh with many layers (several `terrain`s above each other,
# by `wrt.Mesh`). How much do order and early stop save now?
# <details><summary>Solution</summary>
#
# With six layers, 0.3 apart, primary rays fetch 24 nodes with both and 59 with neither: 59 % are saved, instead of 32 % with one layer. Of
# the nodes of diffuse rays, 40 % are saved instead of 11 %. The more there is behind the first hit, the more it pays to find this hit
# early.
# </details>
#
# **4.** RT cores after Turing test triangles at twice the rate. For which structure and rays is that faster in the model? Compare
# pairs of `rates_of(structure)`.
# <details><summary>Solution</summary>
#
# Only where triangle tests are the limit. At 4 boxes per cycle and half a triangle, diffuse rays gain a factor of 2.0 with `bvh8c`, 1.8
# with `bvh8` and 1.2 with `bvh4`, and nothing with `bvh2`. At one triangle per cycle, none gains more than 0.5 %.
# </details>
