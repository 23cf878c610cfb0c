# %% [markdown]
# # Three published claims, counted again
# Papers on ray tracing hardware report nodes per ray, idle lanes and bytes. wrt counts these exactly, without a simulator of clock
# cycles. This notebook repeats three claims on two small generated scenes:
# 1. TTP's table of nodes per ray, and what node width, order of children and culling do to it,
# 2. CoopRT's bound on what idle lanes can gain by helping,
# 3. the bytes that compressed nodes save.
#
# In each plot a bar is wrt's count, and a black line is the published value; its title names the source. The scenes and cameras are not
# those of the papers, so a factor of 1.5 counts as agreement. `python -m wrt bench claims` repeats the claims, and takes the
# papers' scenes as files.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller. The outputs below were made without it.

# %%
import os
import textwrap
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.claims.claim import CLAIMS, Study
from wrt.lab.claims.counted import helped
from wrt.lab.claims.walks import Rules, walk

QUICK = "WRT_QUICK" in os.environ
study = Study(side=24 if QUICK else 64)
SCENES = {"bunny": "statue", "sponza": "hall"}  # published scene -> the generated one in its place


def published(ax, y, value):
    """Draw a published value, or the two ends of a published range, over the bar at y."""
    low, high = value if isinstance(value, tuple) else (value, value)
    ax.fill_betweenx([y - 0.42, y + 0.42], low, high, color="0.2", alpha=0.25, linewidth=0)
    ax.vlines([low, high], y - 0.42, y + 0.42, color="k", linewidth=2.5)


def named(text):
    """Put the generated scene behind the name of the published one."""
    for name, shown in SCENES.items():
        text = text.replace(name, f"{name} ({shown})")
    return text


def show(ax, name, figures, unit):
    """Draw the numbers of a claim that have one unit."""
    for y, each in enumerate(figures):
        ax.barh(y, each.ours, 0.6, color="C1" if each.verdict == "differs" else "C0")
        published(ax, y, each.published)
        text = f" {each.ours:.3g} (published {' to '.join(f'{value:.3g}' for value in np.atleast_1d(each.published))})"
        ax.text(max(each.ours, *np.atleast_1d(each.published)), y, text, va="center", fontsize=8)
    ax.set_yticks(range(len(figures)), [textwrap.fill(named(each.what), 46) for each in figures], fontsize=8)
    ax.invert_yaxis()
    ax.margins(x=0.55)
    ax.set_xlabel(unit)
    ax.set_title(textwrap.fill(CLAIMS[name].source, 86), fontsize=8, loc="left")


# %%
views = {}
for name, shown in SCENES.items():
    rays = study.rays(name)
    first = (rays.depth == 0) & (rays.kind == 0)
    depth = np.zeros(study.side**2)
    depth[rays.pixel[first]] = study.scene(name).accel.closest_hit(rays.origins[first], rays.directions[first]).t
    views[shown] = np.where(np.isfinite(depth), depth, np.nan).reshape(study.side, study.side)
fig, axes = plt.subplots(1, 2, figsize=(6.4, 2.8), dpi=80, layout="constrained")
for ax, (shown, view) in zip(axes, views.items(), strict=True):
    fig.colorbar(ax.imshow(view, cmap="viridis_r"), label="distance (units of the scene)")
    ax.set(title=shown, xlabel="x (pixels)", ylabel="y (pixels)")
plt.show()

# %% [markdown]
# The *statue* replaces the bunny and is seen from outside. The *hall* replaces Sponza and is seen from inside. Each pixel sends one camera
# ray, up to three diffuse bounces, and a shadow ray from each hit.

# %% [markdown]
# ## 1. TTP's table: nodes per ray
# TTP (a prefetcher that predicts the next entries of the stack) gives nodes per ray for each scene. Its nodes have six children in 64
# bytes, a structure that wrt calls `bvh6`. Its walk is that of the simulator Vulkan-Sim: children enter the stack unsorted, and an entry
# that is popped is fetched even if a hit before it has made it useless.

# %%
ttp = [each for each in CLAIMS["ttp-nodes"].measure(study) if "most" not in each.what]
fig, ax = plt.subplots(figsize=(7.4, 3.0), dpi=80, layout="constrained")
show(ax, "ttp-nodes", ttp, "nodes per ray (number)")
plt.show()
for each in ttp:
    if each.verdict == "differs":
        print(textwrap.fill(f"{named(each.what)}: {each.reason}", 120))

# %% [markdown]
# The statue agrees with the bunny, the hall differs from Sponza (orange). The reasons printed above are measurements: shadow rays end
# early, and rays that hit take more nodes.
#
# The same rays by other rules: nodes of 2 to 8 children, with children sorted by distance or not, and with culling of popped entries or
# not.

# %%
RULES = {"unsorted": Rules(False, False), "unsorted, culled": Rules(False, True), "sorted": Rules(True, False),
         "sorted, culled": Rules(True, True)}
WIDTHS = (2, 4, 6, 8)
nodes = {(name, said): [walk(study.tree(name, width), study.rays(name), rule).fetches.mean() for width in WIDTHS]
         for name in SCENES for said, rule in RULES.items()}
fig, axes = plt.subplots(1, 2, figsize=(7.4, 3.6), dpi=80, layout="constrained")
for ax, (name, shown) in zip(axes, SCENES.items(), strict=True):
    for said in RULES:
        ax.plot(WIDTHS, nodes[name, said], "o-", label=said)
    mean = next(each.published for each in ttp if each.what.startswith(f"nodes a ray, {name}"))
    ax.plot(6, mean, "k_", markersize=22, markeredgewidth=2.5)
    ax.annotate(f"published for {name}:\n{mean} (TTP, Table I)", (6, mean), (0, 30), textcoords="offset points", ha="center", fontsize=8,
                arrowprops={"arrowstyle": "-"})
    ax.set(title=f"{shown} (wrt's own finding)", xlabel="children per node (number)", ylabel="nodes per ray (number)",
           xticks=WIDTHS)
    ax.set_ylim(0, 1.35 * max(mean, *nodes[name, "unsorted"]))
    ax.legend(fontsize=7, loc="lower left")
plt.show()
for name, shown in SCENES.items():
    loose, tight = nodes[name, "unsorted"][2], nodes[name, "sorted, culled"][2]
    print(f"{shown}, width 6: {loose:.1f} nodes unsorted, {tight:.1f} sorted and culled: {1 - tight / loose:.0%} fewer")

# %% [markdown]
# **Rules that a simulator chose move the count by a fifth.** Compare proposals by the same rules only.

# %% [markdown]
# ## 2. CoopRT's bound: idle lanes that help
# A warp has 32 lanes with a ray each. It ends with its longest ray, and the other lanes idle. In CoopRT, an idle lane takes an entry from
# the stack of another lane. The plot shows one full warp: the area of the bars is its work, and the red line is its length.

# %%
log, warp = study.ttp("sponza"), study.rays("sponza").warp
cost, steps = log.fetches, helped(log, warp)
sizes = np.bincount(warp)
longest = np.maximum.reduceat(cost, np.searchsorted(warp, np.arange(len(sizes))))
full = np.flatnonzero(sizes == 32)
chosen = full[np.argsort(longest[full] / steps[full])[int(0.75 * len(full))]]
mine = np.sort(cost[warp == chosen])[::-1]
fig, ax = plt.subplots(figsize=(7.0, 2.8), dpi=80, layout="constrained")
ax.bar(range(32), mine, label="fetches of a lane's ray")
ax.axhline(longest[chosen], color="C3", label=f"alone: {longest[chosen]} steps")
ax.axhline(steps[chosen], color="C2", label=f"with help: {steps[chosen]} steps")
ax.axhline(mine.mean(), color="k", linestyle=":", label=f"all lanes always busy: {mine.mean():.1f} steps")
ax.set(xlabel="lane (sorted by length)", ylabel="steps (one fetch each)", title="one warp in the hall")
ax.legend(fontsize=8)
plt.show()

# %% [markdown]
# Help cannot reach the dotted line: at the beginning and at the end of its rays, a warp has fewer entries than lanes. wrt lets any idle
# lane take any entry at once, and memory never waits. So its gain is an **upper bound** on the gain in time.

# %%
coop = list(CLAIMS["coop-rt"].measure(study))
fig, axes = plt.subplots(2, 1, figsize=(7.4, 3.8), dpi=80, layout="constrained")
show(axes[0], "coop-rt", [each for each in coop if each.unit == "%"], "active lanes (%)")
show(axes[1], "coop-rt", [each for each in coop if each.unit == "ratio"], "steps alone over steps with help (ratio)")
plt.show()

# %% [markdown]
# The published gains are gains in time. Path tracing gains most in the paper and here; the order of the two others is not the same.

# %% [markdown]
# ## 3. Compressed nodes
# `bvh8c` stores the planes of eight boxes in 8 bits each, relative to the parent's box (compressed wide nodes, "CWBVH"). Planes are
# rounded outwards, so a ray loses no hit, but enters a few more boxes. `bvh2` has two children with planes of 32 bits.

# %%
compressed = list(CLAIMS["cwbvh"].measure(study))
fig, ax = plt.subplots(figsize=(7.4, 1.7), dpi=80, layout="constrained")
show(ax, "cwbvh", compressed, "bvh8c over bvh2, triangles included (%)")
plt.show()

# %% [markdown]
# The published range is for memory, and both scenes are in it. Bytes per ray fall less. Where do they come from?

# %%
geometry, rays = study.scene("sponza").geometry, study.rays("sponza")
diffuse = rays.part((rays.kind == 0) & (rays.depth > 0))
structures = ("bvh2", "bvh4", "bvh8", "bvh8c")
work = [wrt.build(geometry, each).closest_hit(diffuse.origins, diffuse.directions, counters=True).counters for each in structures]
fig, axes = plt.subplots(1, 2, figsize=(7.4, 2.8), dpi=80, layout="constrained")
nodes, triangles = (np.array([getattr(each, name).mean() for each in work]) for name in ("node_bytes", "primitive_bytes"))
axes[0].bar(structures, nodes, label="nodes")
axes[0].bar(structures, triangles, bottom=nodes, label="triangles")
axes[0].set(xlabel="structure", ylabel="bytes per diffuse ray")
axes[0].margins(y=0.3)
axes[0].legend(fontsize=8)
axes[1].bar(structures, [each.boxes.mean() for each in work], color="C2")
axes[1].set(xlabel="structure", ylabel="boxes per diffuse ray (number)")
plt.show()

# %% [markdown]
# Wide nodes are fetched less often but are larger; 8 bits make them small again. A step further are triangles in 8 bits, and nodes that
# all rays of a warp share:

# %%
fig, ax = plt.subplots(figsize=(7.4, 1.7), dpi=80, layout="constrained")
bits = list(CLAIMS["eight-bits"].measure(study))
show(ax, "eight-bits", bits, "bytes per ray, over 32 bits unshared (%)")
plt.show()
print(textwrap.fill(bits[0].reason, 120))

# %% [markdown]
# ## Exercise: your own hardware
# A trace holds each fetch of each ray. A function from a trace to a trace is an idea for hardware (`docs/rt_core.md` lists the arrays).
# The model turns both traces into clock cycles per ray.

# %%
trace = wrt.trace(wrt.build(geometry, "bvh2"), diffuse.origins, diffuse.directions)


def compare(idea):
    """Plot the terms of the model, in clock cycles per ray, without and with an idea."""
    ax = plt.figure(figsize=(7.0, 2.8), dpi=80, layout="constrained").subplots()
    for i, (said, each) in enumerate({"trace": trace, idea.__name__: idea(trace)}.items()):
        clocks = each.model("rtx2080ti").clocks
        ax.barh(np.arange(len(clocks)) + 0.36 * i - 0.18, list(clocks.values()), 0.34, label=said)
    ax.set_yticks(range(len(clocks)), clocks)
    ax.invert_yaxis()
    ax.set(xlabel="clock cycles per ray and RT core (RTX 2080 Ti, model)", title="the longest bar is the limit")
    ax.legend(fontsize=8)
    plt.show()


def half_nodes(trace):
    """Store each node in half of its bytes."""
    node = trace.address < 2**40
    return replace(trace, address=np.where(node, trace.address // 2, trace.address), size=np.where(node, trace.size // 2, trace.size))


compare(half_nodes)

# %% [markdown]
# **Your turn.** A cache line of 128 bytes holds two nodes, and rays fetch some nodes much more often than others. Write `hot_first(trace)`:
# store the nodes that rays fetch most often side by side. Which terms shrink? Is it a fair comparison?
#
# <details><summary>Solution</summary>
#
# ```python
# def hot_first(trace):
#     """Store the nodes in the order of how often they are fetched."""
#     node = trace.address < 2**40
#     places, index, count = np.unique(trace.address[node], return_inverse=True, return_counts=True)
#     rank = np.empty(len(places), np.int64)
#     rank[np.argsort(-count, kind="stable")] = np.arange(len(places))
#     address = trace.address.copy()
#     address[node] = rank[index] * trace.size[node]
#     return replace(trace, address=address)
#
#
# compare(hot_first)
# ```
# Only L1, L2, DRAM and latency can change, because each ray makes the same tests. The gain is an upper bound: the layout is made from the
# rays that it is measured with. For a fair comparison, rank the nodes by one half of the rays (`trace.ray`), and measure the other half.
# </details>
