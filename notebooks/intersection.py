# %% [markdown]
# # The intersection units and their hard cases
# Does a ray meet a box? Does it meet a triangle? Each test takes about a dozen operations, and one rounding error can make its answer
# wrong: then a ray slips between two triangles that share an edge. This notebook derives both tests, shows how they fail, and mends them.
#
# If the environment variable `WRT_QUICK` is set, there are fewer rays. The outputs below were made without it.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.lab.bench.rays import terrain
from wrt.lab.hard_cases.cases import generate, judge
from wrt.lab.oracle.oracle import closest
from wrt.picture.heatmap import heatmap

QUICK = "WRT_QUICK" in os.environ
SIZE, RAYS = ((160, 90), 2_000) if QUICK else ((480, 270), 20_000)
rng = np.random.default_rng(7)

# %% [markdown]
# ## The box unit: slabs
# A box is the intersection of three slabs. The ray enters and leaves a slab at the distances $(lo - o)/d$ and $(hi - o)/d$, the smaller
# one first. It is in the box from the largest of the three entries to the smallest of the three exits (Kay and Kajiya 1986). If the
# largest entry is behind the smallest exit, the ray misses the box. The reciprocals $1/d$ are computed once per ray. The picture shows,
# like an X-ray picture, the total length of each ray in thirty boxes:

# %%
def slabs(o, inverse, lo, hi):
    """Distances at which rays (N, 3) enter and leave a box, for reciprocal directions."""
    a, b = (lo - o) * inverse, (hi - o) * inverse
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


camera = wrt.Camera.look_at((2.6, 1.9, 3.4), (0, 0, 0), fov_y=np.radians(27))
o, d = wrt.camera_rays(camera, SIZE)
inside = np.zeros(len(o), np.float32)
for _ in range(30):
    center, half = rng.uniform(-1, 1, 3) * (1.6, 0.7, 0.9), rng.uniform(0.05, 0.45, 3)
    enter, leave = slabs(o, 1 / d, (center - half).astype(np.float32), (center + half).astype(np.float32))
    inside += np.maximum(leave - np.maximum(enter, 0), 0)
wrt.side_by_side({"": heatmap(inside.reshape(SIZE[::-1]), "how far each ray runs inside of boxes")})

# %% [markdown]
# ### Hard case: a ray in a face
# A direction without an x component has $1/d_x = \infty$. If the origin is not in one of the two planes, the distances are $-\infty$ or
# $\infty$, which is right. For a ray in the plane itself, a distance is $0\cdot\infty$ = NaN. If minimum and maximum return NaN, every
# comparison with it is false, and the ray is lost. The remedy: choose the near and the far plane of each slab by the sign of the
# direction, and use a minimum and maximum that ignore NaN.

# %%
o1, d1 = np.float32([[1.0, 0.2, 3.0]]), np.float32([[0.0, 0.0, -1.0]])  # in the face x = 1 of the cube from -1 to 1
with np.errstate(divide="ignore", invalid="ignore"):
    a, b = (-1 - o1) / d1, (1 - o1) / d1
    print("distances to the planes:", a[0], b[0])
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    print(f"NaN propagates: enters at {enter[0]}, leaves at {leave[0]}, hit: {bool((enter <= leave)[0])}")
    backwards = np.signbit(d1)
    near, far = np.where(backwards, b, a), np.where(backwards, a, b)
    enter, leave = np.fmax.reduce(near, axis=1), np.fmin.reduce(far, axis=1)  # fmax and fmin ignore NaN
    assert (enter <= leave).all()
    print(f"NaN is ignored: enters at {enter[0]}, leaves at {leave[0]}, hit: {bool((enter <= leave)[0])}")

# %% [markdown]
# ### Hard case: a ray through an edge
# At an edge of the box, the ray leaves one slab where it enters another. Entry and exit are nearly equal, and rounding decides. Each has
# three rounding errors (of a subtraction, a reciprocal and a product). Multiplying the exit by $1 + 2\gamma_3$ saves all rays (Ize 2013).
# Here $\gamma_n = nu/(1-nu)$ and $u = 2^{-24}$. The cell compares rays at edges with the same test in float64:

# %%
n = 20 * RAYS
axis, sides, place = rng.integers(3, size=n), rng.choice([-1.0, 1.0], (n, 3)), rng.uniform(-1, 1, n)
target = sides.copy()
target[np.arange(n), axis] = place  # on an edge of the cube from -1 to 1
o = rng.normal(size=(n, 3)).astype(np.float32)
o *= (3 / np.linalg.norm(o, axis=1, keepdims=True)).astype(np.float32)
d = (target - o).astype(np.float32)
lo, hi = np.float32(-1), np.float32(1)

enter, leave = slabs(o.astype(np.float64), 1 / d.astype(np.float64), -1.0, 1.0)
hit = enter <= leave
enter, leave = slabs(o, 1 / d, lo, hi)
u = 2.0**-24
wide = leave * np.float32(1 + 2 * 3 * u / (1 - 3 * u))
lost = {"plain": hit & ~(enter <= leave), "widened": hit & ~(enter <= wide)}
extra = ~hit & (enter <= wide)
print(f"{hit.sum()} of {n} rays meet the cube; lost: " + ", ".join(f"{name} {rays.sum()}" for name, rays in lost.items()))
print(f"misses that the widened test reports as hits: {extra.sum()}")
assert not lost["widened"].any()

# %% [markdown]
# A false hit of a box only costs further tests; a lost ray is a hole in the picture. So wrt's default box unit (`box="conservative"`)
# never reports a false miss. For boxes of triangles it widens by more than here, because the triangle unit rounds, too
# (`kernels/units/box.py` derives the factor).
#
# ## A plane, and three caveats
# The points of a plane through $v_0$ with the normal $n$ have $n\cdot(p - v_0) = 0$. The ray's point $o + t\,d$ is one of them if
#
# $$t = \frac{n\cdot(v_0 - o)}{n\cdot d}.$$
#
# One line of code, and three ways to be wrong. The camera looks horizontally over the floor $y = 0$. Each picture mends one caveat and
# shows the next one in red:
# 1. **The ray is parallel to the plane**: $n\cdot d = 0$. The quotient is infinite or NaN, and so is the hit point.
# 2. **The hit is outside of the ray's segment**: $t < t_{min}$ or $t > t_{max}$. Rays to the sky meet the floor behind the camera.
# 3. **The point $o + t\,d$ is rounded**, so that it is rarely on the plane. A shadow ray from a point below meets the floor again.

# %%
def plane(o, d, v0, n):
    with np.errstate(divide="ignore", invalid="ignore"):
        return ((v0 - o) @ n / (d @ n)).astype(np.float32)


def checkers(p, hit, wrong):
    squares = (np.floor(np.where(hit, p[:, 0], 0)) + np.floor(np.where(hit, p[:, 2], 0))) % 2
    color = np.where(hit[:, None], 0.35 + 0.5 * squares[:, None] * [1, 0.95, 0.8], [0.7, 0.82, 0.95])
    color[wrong] = (0.85, 0.05, 0.1)
    return np.rint(255 * color.reshape(wide[1], wide[0], 3) ** (1 / 2.2)).astype(np.uint8)


wide = (SIZE[0], SIZE[1] // 2 * 2 + 1)  # an odd number of rows: the rays of the middle row are exactly horizontal
level = wrt.Camera.look_at((0.3, 1.1, 5.0), (0.3, 1.1, 0.0), fov_y=np.radians(50))
o, d = wrt.camera_rays(level, wide)
floor, up, light = np.zeros(3, np.float32), np.float32([0, 1, 0]), np.float32([0.4, 0.8, -0.3])
t = plane(o, d, floor, up)
with np.errstate(invalid="ignore", over="ignore"):
    p = o + t[:, None] * d
parallel = d @ up == 0
behind = ~parallel & (t < 0)
hit = ~parallel & ~behind
again = plane(p, np.tile(light, (len(p), 1)), floor, up)
acne = hit & (again > 0)
assert not np.isfinite(p[parallel]).all(axis=1).any() and parallel.sum() == wide[0]  # 1: no hit point is a number
assert (behind == (d[:, 1] > 0)).all()  # 2: just the rays that rise
assert acne.any() and (p[acne, 1] < 0).all()  # 3: just the points below the floor
wrt.side_by_side({f"1. parallel: {parallel.sum()} rays": checkers(np.where(parallel[:, None], 0, p), ~parallel, parallel),
                  f"2. behind the camera: {behind.sum()} rays": checkers(p, hit, behind),
                  f"3. in its own shadow: {acne.sum()} of {hit.sum()} points": checkers(p, hit, acne),
                  "all three mended": checkers(p, hit, acne & False)}, columns=2)

# %% [markdown]
# The remedies: a hit needs $n\cdot d \ne 0$. It needs $t_{min} \le t \le t_{max}$; a comparison with NaN is false, so write the test such
# that false means "no hit". And a new ray starts outside the error of its origin, or ignores the surface on which it starts
# ([whitted](whitted.ipynb) compares this with a fixed epsilon). A triangle adds a fourth condition: the point is between its edges.
#
# ## The triangle unit: Moeller and Trumbore
# Let $e_1 = v_1 - v_0$ and $e_2 = v_2 - v_0$ be edges. A point of the triangle is $v_0 + u\,e_1 + v\,e_2$. A point of the ray is $o +
# t\,d$. Equating both points gives three linear equations for $t$, $u$ and $v$. Cramer's rule solves them with two cross products. The
# ray hits the triangle if $u \ge 0$, $v \ge 0$ and $u + v \le 1$.

# %%
def moeller_trumbore(o, d, v0, v1, v2):
    """Return t, u, v where rays (N, 3) meet the plane of one triangle (1997)."""
    e1, e2, s = v1 - v0, v2 - v0, o - v0
    p, q = np.cross(d, e2), np.cross(s, e1)
    determinant = p @ e1
    return q @ e2 / determinant, (s * p).sum(axis=1) / determinant, (d * q).sum(axis=1) / determinant


o, d = wrt.camera_rays(wrt.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=np.radians(40)), SIZE)
t, u, v = moeller_trumbore(o, d, *np.float32([[-1.3, -0.8, 0], [1.3, -0.6, 0], [0.1, 0.95, 0]]))
hit = (u >= 0) & (v >= 0) & (u + v <= 1)
weights = np.where(hit[:, None], np.stack([1 - u - v, u, v], axis=1), 0.0)
codes = np.rint(255 * (weights / weights.max(axis=1, keepdims=True, initial=1e-9)) ** (1 / 2.2)).astype(np.uint8)
wrt.side_by_side({"the weights of the three corners as red, green, blue": codes.reshape(*SIZE[::-1], 3)})

# %% [markdown]
# ## Hard case: where triangles meet
# These pictures magnify a corner that eight triangles share. The directions of neighbouring pixels differ by *one float32 step*. The
# colour shows which triangle the ray hits. Black is a miss: the ray has passed through the surface.

# %%
angles = 2 * np.pi * np.arange(8) / 8
ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1) * rng.uniform(1.0, 1.3, (8, 1))
ring[:, 2] = rng.normal(0, 0.4, 8)
vertices = np.concatenate([np.zeros((1, 3)), ring]) + (3.1, -1.7, -7.3)
fan = wrt.Mesh(vertices, [[0, 1 + i, 1 + (i + 1) % 8] for i in range(8)], name="fan")

origin, side = np.float32([0.3, 0.2, 1.1]), 80
to_vertex = fan.vertices[0] - origin
step = np.spacing(np.abs(to_vertex))
y, x = np.mgrid[side // 2:-side // 2:-1, -side // 2:side // 2]
directions = (to_vertex + np.stack([x * step[0], y * step[1], 0 * x], axis=-1)).reshape(-1, 3).astype(np.float32)
origins = np.tile(origin, (side * side, 1))
print("one step is", ", ".join(f"{s / np.abs(t):.1e}" for s, t in zip(step[:2], to_vertex[:2], strict=True)), "of the direction")

TESTS = ("watertight", "moeller_trumbore", "baldwin_weber", "plane")
palette = np.rint(255 * plt.get_cmap("Set2")(np.arange(8))[:, :3]).astype(np.uint8)
palette = np.concatenate([palette, np.zeros((1, 3), np.uint8)])  # prim_id -1, a miss: the last one

exact = closest(fan, origins, directions)
seen = {"exact": exact.prim_id}
for test in TESTS:
    seen[test] = wrt.build(fan, "brute_force", triangle=test).closest_hit(origins, directions).prim_id
wrt.side_by_side({f"{name}: {(ids < 0).sum()} lost": palette[ids].reshape(side, side, 3) for name, ids in seen.items()},
                 columns=3, scale=4)

# %% [markdown]
# The picture "exact" is from the oracle (`wrt.lab.oracle.oracle`): integer arithmetic decides on which side of an edge a ray passes. It
# takes the float32 directions and corners as exact. No float32 test has the edges exactly in place. But the watertight test leaves no
# gap: **an edge may be displaced, as long as both of its triangles displace it equally**.

# %%
for name in TESTS:
    print(f"{name:17} another triangle than the oracle's: {(seen[name] != exact.prim_id).mean():.1%} of the rays;"
          f" lost: {(seen[name] < 0).sum()}")
assert (seen["watertight"] >= 0).all() and (seen["moeller_trumbore"] < 0).any()

# %% [markdown]
# ## Why the watertight test leaks nowhere
# Woop, Benthin and Wald (2013) transform the corners. A translation and a shear make the ray the z axis, so that x and y suffice. The
# sign of $a_x b_y - a_y b_x$ gives the side on which the ray passes the edge $ab$. The neighbour triangle has the same edge in the
# reverse direction, and computes $b_x a_y - b_y a_x$: *the same two products*, subtracted the other way. After rounding, the two results
# are still exact opposites. Moeller and Trumbore compute $u$ of one triangle and $v$ of its neighbour by different operations, so their
# rounding errors differ.

# %%
n = 50 * RAYS
a, b = rng.normal(size=(2, n, 2)).astype(np.float32)
b = np.where(rng.random((n, 1)) < 0.5, b, a * rng.normal(size=(n, 1)).astype(np.float32))  # half: the ray is on the edge, nearly
one = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
other = b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]
print(f"edges tested from both triangles: {n}; results that are not exact opposites: {(one != -other).sum()}")
assert (one == -other).all()

# %% [markdown]
# A compiler can break this symmetry. If it fuses a product and the difference into one operation (fused multiply-add), only the other
# product is rounded, and the two results are no opposites any more. So wrt compiles its kernels without fusing. If an edge function is
# exactly 0, float64 decides.
#
# ## Lost rays in a picture
# Random rays rarely meet an edge, but many rays of pictures are not random. Examples are textures whose texels lie on vertices, shadow
# rays to the corners of lights, and cameras in the middle of symmetric models. Here each pixel's ray is turned to the nearest corner of
# the triangle that it hits. With $d = v - o$ in float32, the hit must be at $t = 1$. The ray is lost if it passes through the surface
# there. At an outline it may pass; so only corners with surface on all sides count, where four rays close by all hit.

# %%
hills = terrain(60 if QUICK else 250)
camera = wrt.Camera.look_at((0.05, 0.9, 1.5), (0.0, -0.2, 0.0), fov_y=np.radians(44))
origins, directions = wrt.camera_rays(camera, SIZE)
hits = wrt.build(hills).closest_hit(origins, directions)
hit = hits.prim_id >= 0
weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
corner = hills.faces[hits.prim_id, weights.argmax(axis=1)]
turned = np.where(hit[:, None], hills.vertices[corner] - origins, directions)
beside = 1e-4 * np.array([camera.camera_to_world[:3, 0], camera.camera_to_world[:3, 1]], np.float32)
within = hit.copy()
for offset in (*beside, *-beside):
    within &= wrt.build(hills).closest_hit(origins, turned + offset).t < 1.01

corners = hills.vertices[hills.faces].astype(np.float64)
normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
light = np.clip(normals @ np.array([0.55, 0.65, 0.52]), 0.05, 1.0)

pictures = {}
for test in TESTS[:2]:
    found = wrt.build(hills, triangle=test).closest_hit(origins, turned)
    lost = within & ~(found.t < 1.01)
    color = np.where(hit[:, None], light[found.prim_id, None] * (0.55, 0.75, 0.45), (0.72, 0.82, 0.95))
    color[lost] = (0.9, 0.0, 0.1)
    codes = np.rint(255 * color ** (1 / 2.2)).astype(np.uint8).reshape(*SIZE[::-1], 3)
    assert test != "watertight" or not lost.any()
    pictures[f"{test}: {lost.sum()} of {within.sum()} rays lost"] = codes
wrt.side_by_side(pictures, columns=1 if QUICK else 2)

# %% [markdown]
# ## Lost rays in the hard cases
# `wrt.lab.hard_cases.cases` has 44 kinds of rays at which rounding errors matter. For most of them the answer is known: a ray that starts
# inside a closed surface must hit it. The plot shows the lost rays of each test:

# %%
CASES = {"A_origin_vertices": "dense sphere, at vertices", "A_far_uniform": "the same, far from 0",
         "B_jittered_vertices": "jagged ball, at vertices", "F_needles_edges": "needles, at edges"}
shares = {test: [] for test in TESTS}
for case in (generate(name, RAYS) for name in CASES):
    for test in TESTS:
        found = wrt.build(case.geometry, "bvh2", triangle=test).closest_hit(case.origins, case.directions, case.t_min, case.t_max)
        shares[test].append((found.prim_id < 0).mean())
        if test == "watertight":
            assert judge(case, found, 200).ok  # compared with the oracle: no hit lost, invented or on a wrong triangle

fig, ax = plt.subplots(figsize=(7.2, 3.0), dpi=80, layout="constrained")
for i, test in enumerate(TESTS):
    bars = ax.barh(np.arange(len(CASES)) + 0.2 * (i - 1.5), 100 * np.array(shares[test]), 0.2, label=test, color=f"C{i}")
    ax.bar_label(bars, [f"{100 * share:.2g}" for share in shares[test]], padding=2, fontsize=8)
ax.set_yticks(np.arange(len(CASES)), CASES.values())
ax.invert_yaxis()
ax.margins(x=0.1)
ax.set(xlabel=f"% of {RAYS} rays lost, each of which must hit")
ax.legend()
plt.show()

# %% [markdown]
# The watertight test loses no ray in any case, and is wrt's default. The other tests are for comparison; select one by its name, such as
# `triangle="moeller_trumbore"`. `docs/accuracy.md` compares 114 million rays of all cases with Embree and other libraries.
#
# ## Exercises
# **1.** Sort the two distances of a slab by `np.fmin` and `np.fmax` instead of by the sign of the direction. Does the test find the ray in
# the face? Does it find a ray in the opposite face?
# <details><summary>Solution</summary>
#
# For the ray in the face, the distances along x are $-\infty$ and NaN. Both functions return $-\infty$, so the ray "leaves" at $-\infty$
# and is lost. In the opposite face they are NaN and $\infty$; both return $\infty$, and the ray "enters" at $\infty$: lost, too. Sorting by
# sign keeps entry and exit apart, and a NaN is ignored in its own place.
# </details>
#
# **2.** In the magnified pictures, let neighbouring pixels differ by 1000 steps instead of one. Which gaps remain? Why are the gaps at the
# vertex the last to vanish?
# <details><summary>Solution</summary>
#
# The gaps are a few rounding steps wide, so that wide steps leap over them: with 100 steps between pixels a handful of rays are lost,
# with 1000 none. At the vertex, eight edges and so eight gaps meet.
# </details>
#
# **3.** Move the hills far away from 0 (`vertices + 1e4`) and the camera with them. Which test loses more rays now, and which fewer?
# <details><summary>Solution</summary>
#
# The watertight test loses none in either place. Baldwin and Weber's test loses over twice as many rays as before: it stores planes
# computed from large coordinates. The test `plane` loses hardly fewer. Moeller and Trumbore's test loses none there: near $10^4$, float32
# coordinates lie on a coarse lattice, so that the differences of corners and origin are exact (use `beside = 1e-2 * ...`).
# </details>
#
# **4.** `python -m wrt stability A B` runs two groups of cases over all tests; `--rays 1000000` takes a while. Which test loses no ray?
# <details><summary>Solution</summary>
#
# `watertight`, in all 44 kinds of cases (`docs/accuracy.md`).
# </details>
