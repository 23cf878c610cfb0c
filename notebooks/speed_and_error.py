# %% [markdown]
# # Speed against error
# A rendered picture is an estimate: more time gives less error. How fast does the error fall? Can a render estimate its own error? When
# is the picture good enough? Which errors remain with any number of samples? And how exact is a single hit?
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller and samples fewer. The outputs below were made without it. Times
# depend on the machine. All other results are the same everywhere, because samples depend only on pixel, sample index and seed.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench import error
from wrt.lab.bench.rays import ray_sets, terrain
from wrt.lab.bench.report import run
from wrt.lab.oracle.oracle import closest, t_bound
from wrt.picture.heatmap import colored

QUICK = "WRT_QUICK" in os.environ
SIZE, SMALL = ((96, 54), (48, 27)) if QUICK else ((240, 135), (96, 54))
MOST, REPEATS, RAYS = (8, 3, 1_000) if QUICK else (64, 5, 20_000)
room = wrt.load_scene("../scenes/sphere_light.toml")

# %% [markdown]
# ## Noise
# Two glowing balls light a room. From each hit, a shadow ray goes to a random point on each ball, so that penumbrae are noisy. Below each
# picture is its error: the absolute difference from a converged picture, in radiance, averaged over the colour channels.

# %%
truth = wrt.render(room, size=SIZE, spp=8 * MOST, seed=99).pixels.astype(np.float64)
pictures, errors = {}, {}
for spp in (1, 4, 16):
    film = wrt.render(room, size=SIZE, spp=spp)
    distance = np.abs(film.pixels - truth).mean(axis=2)
    pictures[f"{spp} a pixel"] = film
    errors[f"mean {distance.mean():.4f}, white is 0.1"] = colored(distance, top=0.1)
wrt.side_by_side({**pictures, **errors}, columns=3)

# %% [markdown]
# Most of the error is at the outlines of the lamps, where one pixel contains very bright and dark parts. The penumbrae have the next
# largest error.

# %% [markdown]
# ## How fast does the error fall?
# `wrt bench error` renders with 1, 2, 4 ... samples per pixel and several seeds, and compares the pictures with a reference.
# The seeds give error bars. They also separate noise, which differs between seeds, from bias, which does not. The sweep covers both
# samplers: independent random numbers, and scrambled Sobol points, which are spread evenly.

# %%
sweep = run(error.Plan(room, size=SMALL, knobs=("sampler",), max_spp=MOST, repeats=REPEATS, reference_spp=4 * MOST))
sweep

# %%
LEVELS = [2**k for k in range(MOST.bit_length())]


def axes():
    _, ax = plt.subplots(figsize=(6.4, 3.6), dpi=80, layout="constrained")
    ax.set(xscale="log", yscale="log", xlabel="samples a pixel", ylabel="root mean squared error")
    ax.set_xticks(LEVELS, LEVELS)
    ax.set_yticks([0.02, 0.05, 0.1, 0.2, 0.4], ["0.02", "0.05", "0.1", "0.2", "0.4"])
    ax.minorticks_off()
    return ax


ax = axes()
for label, name in {"as it is": "sobol (the default)", "sampler = independent": "independent"}.items():
    rows = [row for row in error.pictures_of(sweep) if row.variant == label]
    rmse = np.array([row.rmse.value for row in rows])
    bars = np.abs(np.array([(row.rmse.low, row.rmse.high) for row in rows]).T - rmse)
    ax.errorbar([row.spp for row in rows], rmse, bars, fmt="o-", capsize=3, label=name)
n = np.array([1.0, MOST])
ax.plot(n, rmse[0] / n**0.5, "k:", linewidth=1, label="one over the square root of the samples")
ax.legend()
plt.show()
for slope in error.slopes(sweep):
    print(f"{slope.variant:22} squared error falls as the samples to the power {slope.mse.value:.2f}; theory: {slope.theory}")

# %% [markdown]
# ## Can a render estimate its own error?
# `film.variance` is the variance of each pixel's mean, estimated from the pixel's own samples. For independent samples the estimate is
# right on average: error over estimated error is normally distributed with standard deviation 1 (the "width" below). Sobol points are
# spread evenly, so that their mean is more accurate than the spread of the samples suggests. For them the estimated error is too large.

# %%
fig, ax = plt.subplots(figsize=(6.4, 3.2), dpi=80, layout="constrained")
edges = np.linspace(-5, 5, 81)
for sampler in ("independent", "sobol"):
    film = wrt.render(room, size=SIZE, spp=16, sampler=sampler)
    lit = film.variance > 0
    z = (film.pixels - truth)[lit] / np.sqrt(film.variance[lit])
    width = 0.5 * np.diff(np.percentile(z, (15.87, 84.13)))[0]  # of a normal distribution, its standard deviation
    ax.stairs(np.histogram(z, edges, density=True)[0], edges, linewidth=1.8, label=f"{sampler}: width {width:.2f}")
    print(f"{sampler:12} estimated {np.sqrt(film.variance.mean()):.5f}, true {np.sqrt(np.mean((film.pixels - truth) ** 2)):.5f}")
x = np.linspace(-5, 5, 200)
ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), "k:", linewidth=1, label="normal, width 1")
ax.set(xlabel="error of a pixel over its estimated error", ylabel="density")
ax.legend(fontsize=9)
plt.show()

# %% [markdown]
# ## When is the picture good enough?
# With `target_error`, wrt renders until the estimated error of the whole picture is below the target. It splits the samples into four
# independent sequences, whose spread estimates the error of Sobol points, too.

# %%
for target in (0.1, 0.05) if QUICK else (0.04, 0.02, 0.01):
    film = wrt.render(room, size=SIZE, target_error=target)
    true = np.sqrt(np.mean((film.pixels - truth) ** 2))
    estimated = film.stats["estimated_error"]
    print(f"target {target}: {film.samples.max():4} samples a pixel, estimated error {estimated:.5f}, true {true:.5f}")

# %% [markdown]
# wrt checks the error when each sequence has 1, 2, 4, 8 ... samples, because a Sobol sequence is most even then. So the final error is
# often well below the target.
#
# ## Errors that remain
# More samples reduce noise, but not bias. With `max_depth=0` the mirror ball is black for every seed, and this error remains.

# %%
ax = axes()
for depth in (4, 1, 0):
    films = [wrt.render(room, size=SMALL, spp=spp, max_depth=depth) for spp in LEVELS]
    rmse = [np.sqrt(np.mean((film.pixels - sweep[0].pixels) ** 2)) for film in films]
    label = f"max_depth {depth}: {films[-1].stats['rays_per_sample']:.2f} rays a sample"
    ax.plot(LEVELS, rmse, {0: "s--", 1: "o-", 4: "-"}[depth], linewidth=6 if depth == 4 else 1.5, label=label)
ax.legend()
plt.show()
shown = {f"max_depth {depth}": wrt.render(room, size=SIZE, spp=16, max_depth=depth) for depth in (0, 1)}
wrt.side_by_side(shown)

# %% [markdown]
# This scene needs only one bounce: there is one mirror, and it shows nothing that reflects. With one sample per pixel, noise hides the
# missing bounce; with 64, the missing bounce is most of the error. So find out which error a picture has before you spend time on it.

# %% [markdown]
# ## How exact is a hit?
# The oracle (`wrt.lab.oracle.oracle`) computes in float64, and in integer arithmetic where float64 is not exact enough. Its $t$ is exact
# to 14 digits. The plot shows the error of each triangle test's $t$ in float32 steps (ulp) of $t$. The rays start on a terrain into
# random directions.

# %%
hills = terrain(40 if QUICK else 150)
rays = ray_sets(wrt.build(hills, "bvh2"), RAYS)["diffuse"]
exact = closest(hills, rays.origins, rays.directions)
fig, ax = plt.subplots(figsize=(6.4, 3.2), dpi=80, layout="constrained")
for test in ("watertight", "moeller_trumbore", "baldwin_weber", "plane"):
    hits = wrt.build(hills, "bvh2", triangle=test).closest_hit(rays.origins, rays.directions)
    same = (hits.prim_id == exact.prim_id) & (exact.prim_id >= 0)
    ulp = np.abs(hits.t[same] - exact.t[same]) / np.spacing(exact.t[same].astype(np.float32))
    ax.plot(np.sort(ulp), 1 - np.arange(len(ulp)) / len(ulp), label=f"{test}: median {np.median(ulp):.2g}", linewidth=1.8)
    if test == "watertight":
        bound = t_bound(rays.origins[same], rays.directions[same], hills.vertices[hills.faces[exact.prim_id[same]]])
        share = np.abs(hits.t[same] - exact.t[same]) / bound
        print(f"watertight: the largest error is {share.max():.2f} of the bound derived for its ray and triangle")
        assert share.max() <= 1.0
ax.set(xscale="log", yscale="log", xlabel="error of t, ulp", ylabel="share of hits with more", xlim=(0.1, None))
ax.legend(fontsize=9)
plt.show()

# %% [markdown]
# More than half of the watertight test's distances are the float32 value nearest to the exact one. Fewer than one in a thousand is off by
# ten steps or more. The plane equation and Baldwin and Weber's test compute $t$ from a rounded plane; one in two hundred of their
# distances is off by a hundred steps. This matters because a new ray must start outside the error of its origin. wrt uses the derived
# bound of each hit for this, and no fixed epsilon.
#
# ## Exercises
# **1.** Render `scenes/whitted.toml` instead, which has no soft shadows. How fast does Sobol's error fall there?
# <details><summary>Solution</summary>
#
# The squared error falls as the samples to the power -1.5 in both scenes; independent samples reach -1.0. Without soft shadows only the
# two dimensions of the pixel filter matter. They contain edges, which limit the gain: evenly spread points in a plane with an edge reach
# -1.5.
# </details>
#
# **2.** `error.KNOBS` names the settings that can vary. Which of them do not change this scene's pixels (`error.same_pixels(sweep)`)?
# <details><summary>Solution</summary>
#
# The structure (`accel`) and the box test never change a bit. `max_depth` of 1 or more and `min_throughput` change nothing here, because
# there is one mirror and its rays end on matte surfaces. The sampler and the triangle test do change pixels.
# </details>
#
# **3.** How many samples does the independent sampler need for `target_error=0.01`?
# <details><summary>Solution</summary>
#
# 512 per pixel, where Sobol points need 128. Its error falls with the square root of the samples, so each halving takes four times as
# many.
# </details>
#
# **4.** `python -m wrt bench queries bvh8 bvh8:triangle=plane` compares two triangle tests. Are more exact tests slower?
# <details><summary>Solution</summary>
#
# Hardly. On a busy machine, the watertight test took up to 1.1 times as long as the other triangle tests for rays from a camera, and 1.1
# to 1.4 times for random rays.
# </details>
