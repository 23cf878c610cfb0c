# %% [markdown]
# # Whitted's tree of rays
# A camera ray meets glass. Part of the light is reflected, the rest is refracted, so that two new rays begin. Each of them may meet glass
# again: the rays of one pixel form a tree (Whitted 1980). This notebook shows such a tree, derives the law at each of its branches, and
# checks the law on the rays that wrt traces. Then it builds the whole tracer in Python, asks what a cut of the tree loses, and how far
# from a surface a new ray must start.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller and rays fewer. The outputs below were made without it. Lengths are
# in the scene's own unit, angles in degrees.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.picture.heatmap import colored
from wrt.renderer.inspector.inspect import Inspector
from wrt.scene.shapes import quad

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP, PIXELS = ((160, 90), 2, 12) if QUICK else ((400, 225), 16, 60)
rng = np.random.default_rng(5)
plt.switch_backend(plt.get_backend())  # the notebook shows figures from now on

# %% [markdown]
# ## The tree of a pixel
# `wrt.inspect` traces one pixel as `wrt.render` does, and keeps every ray. The *throughput* of a ray is the share of its light that
# arrives at the camera. A ray *adds* the light of its hit, times this share. The sum over the tree is the sample's radiance; the mean of
# the samples is the pixel, to the last bit.

# %%
scene = wrt.load_scene("../scenes/whitted.toml")
pixel = x, y = (300, 120)
tree = wrt.inspect(scene, pixel, sample=0)
print(tree)
every = wrt.inspect(scene, pixel, spp=4)
picture = wrt.render(scene, spp=4, crop=(x, y, x + 1, y + 1))
assert (every.radiance == picture.pixels.reshape(3)).all()

# %%
def shown(inspection):
    figure = inspection.figure()
    figure.set_dpi(72)
    return figure


shown(tree)

# %% [markdown]
# At a matte surface, a *shadow ray* asks each light whether it is seen (dashed lines). A tree ends at matte surfaces, at the background,
# or where it is cut.
#
# ## Reflection
# The reflected ray lies in the plane of the ray $d$ and the normal $n$, and leaves at the angle at which $d$ arrives:
#
# $$r = d - 2 (d\cdot n)\,n.$$
#
# The next cells collect all branches in the trees of many pixels of two scenes: a ball of glass (index of refraction 1.5), and a slab
# (1.5) and a prism (1.62) of coloured glass.

# %%
def trees(name, low, high):
    """Return the rays of random pixels between two corners."""
    inspector = Inspector(f"../scenes/{name}.toml", spp=1)
    return [ray for xy in rng.integers(low, high, (PIXELS, 2)) for ray in inspector.pixel(tuple(xy.tolist()), 0).samples[0].rays]


def unit(v):
    return v / np.linalg.norm(v)


rays = trees("whitted", (220, 50), (310, 190)) + trees("glass_slab", (170, 110), (330, 220)) + trees("glass_slab", (400, 170), (500, 270))
INDEX = {"in front": 1.5, "slab": 1.5, "prism": 1.62}
branches = [(ray, child) for ray in rays if ray.object in INDEX for child in ray.children if np.isfinite(child.direction).all()]
errors = []
for ray, child in branches:
    if child.kind == "reflected":
        d, n = unit(ray.direction), ray.shading_normal
        errors.append(np.abs(unit(child.direction) - (d - 2 * (d @ n) * n)).max())
worst = max(errors)
print(f"{len(rays)} rays, {len(branches)} branches at glass; largest error of a reflected direction: {worst:.1e}")
assert len(branches) > 100 * (1 - QUICK) and worst < 1e-5

# %% [markdown]
# ## Refraction and total reflection
# Light changes its speed at a boundary. Snell's law gives the angles from the normal on both sides: $n_1\sin\theta_1 = n_2\sin\theta_2$.
# With $\eta = n_2/n_1$ and $c = -d\cdot n$, the refracted ray is
#
# $$ f = \frac{d}{\eta} + \Big(\frac{c}{\eta} - c_2\Big)\,n,\qquad c_2 = \sqrt{1 - (1 - c^2)/\eta^2}.$$
#
# In glass, sines above $1/n$ would need $\sin\theta_2 > 1$. Then no light leaves, and all of it is reflected: *total reflection*.

# %%
def refracted(d, n, eta):
    """Return the refracted unit direction of d, with n on the ray's side; None at total reflection."""
    c = -d @ n
    square = 1 - (1 - c * c) / eta**2
    return None if square <= 0 else d / eta + (c / eta - np.sqrt(square)) * n


fig, axes = plt.subplots(1, 2, figsize=(9.6, 3.8), dpi=80, layout="constrained", width_ratios=(1.25, 1))
axes[0].axhspan(-1.2, 0, color="#d3e8f5")
critical = np.degrees(np.arcsin(1 / 1.5))
for angle in (0, 12, 24, 36, critical - 0.5, 50, 62):
    d, n = np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle))]), np.array([0.0, -1.0])
    out, color = refracted(d, n, 1 / 1.5), plt.get_cmap("viridis")(angle / 70)
    axes[0].plot([-d[0] * 1.0, 0], [-d[1] * 1.0, 0], color=color)
    axes[0].plot([0, d[0]], [0, -d[1]], color=color, linestyle="-" if out is None else ":")
    if out is not None:
        axes[0].plot([0, out[0]], [0, out[1]], color=color, label=f"{angle:.0f} to {np.degrees(np.arcsin(out[0])):.0f} degrees")
    else:
        axes[0].plot([], [], color=color, label=f"{angle:.0f}: total reflection")
axes[0].set(aspect="equal", xlim=(-1.1, 2.6), ylim=(-1.1, 1.1), xlabel="x, units", ylabel="y, units")
axes[0].set_title("from glass (blue, n = 1.5) into air, from the left; dotted: the reflected part", fontsize=9)
axes[0].legend(fontsize=8, loc="right", title="angles from the normal")


def sine(ray, direction):
    return np.linalg.norm(np.cross(unit(direction), ray.shading_normal))


groups, total = {}, []
for ray in rays:
    if ray.object in INDEX:
        through = [child for child in ray.children if child.kind == "refracted"]
        eta = INDEX[ray.object] if ray.front else 1 / INDEX[ray.object]
        if through and np.isfinite(through[0].direction).all():
            groups.setdefault(eta, []).append((sine(ray, ray.direction), sine(ray, through[0].direction)))
        elif not through and not ray.ended.startswith("cut"):
            total.append((sine(ray, ray.direction), 1 / eta))
for i, (eta, pairs) in enumerate(sorted(groups.items())):
    one, two = np.array(pairs).T
    assert np.abs(one - eta * two).max() < 2e-6  # Snell's law on each traced ray
    s = np.linspace(0, min(1, eta), 2)
    axes[1].plot(s, s / eta, color=f"C{i}", linewidth=1)
    axes[1].plot(one, two, ".", color=f"C{i}", label=f"$n_2/n_1$ = {eta:.3g}: {len(pairs)} traced rays")
assert total and all(s * n > 1 for s, n in total)
axes[1].plot([s for s, _ in total], [1.03] * len(total), "kx", markersize=4, label=f"{len(total)} total reflections")
axes[1].set(xlabel=r"$\sin\theta_1$, before the boundary", ylabel=r"$\sin\theta_2$, behind it", xlim=(0, 1.02), ylim=(0, 1.08))
axes[1].legend(fontsize=8, loc="lower right")
plt.show()
print(f"critical angle of glass: {critical:.1f} degrees")

# %% [markdown]
# A prism deflects rays, and inner reflections make its tree deep:

# %%
shown(wrt.inspect("../scenes/glass_slab.toml", (440, 215), sample=0, min_throughput=0.01))

# %% [markdown]
# ## Fresnel: how much is reflected
# Maxwell's equations give the share of each polarisation that a boundary reflects (Fresnel 1823). With $c = \cos\theta_1$ and
# $c_2 = \cos\theta_2$:
#
# $$R_\parallel = \Big(\frac{\eta c - c_2}{\eta c + c_2}\Big)^2,\qquad R_\perp = \Big(\frac{c - \eta c_2}{c + \eta c_2}\Big)^2,\qquad
# F = \tfrac12 (R_\parallel + R_\perp).$$
#
# Schlick (1994) approximates $F$ by $F_0 + (1 - F_0)(1 - c)^5$, where $F_0 = ((\eta-1)/(\eta+1))^2$ and $c$ is the cosine *on the side of
# the lower index*. The dots are the shares in the traced trees: throughput of the reflected ray over that of the arriving ray.

# %%
def fresnel(c, eta):
    """Return the reflected shares of both polarisations at the cosine c; 1 at total reflection."""
    square = 1 - (1 - c * c) / eta**2
    c2 = np.sqrt(np.maximum(square, 0))
    parallel, across = (eta * c - c2) / (eta * c + c2), (c - eta * c2) / (c + eta * c2)
    return np.where(square > 0, parallel**2, 1), np.where(square > 0, across**2, 1)


def exact(c, eta):
    return 0.5 * sum(fresnel(c, eta))


def schlick(c, eta):
    if eta < 1:
        square = 1 - (1 - c * c) / eta**2
        c = np.sqrt(np.maximum(square, 0))
    f0 = ((eta - 1) / (eta + 1)) ** 2
    return f0 + (1 - f0) * (1 - c) ** 5


angle = np.linspace(0, 89.99, 2000)
c = np.cos(np.radians(angle))
brewster = np.degrees(np.arctan(1.5))
assert np.isclose(exact(1.0, 1.5), 0.04) and np.isclose(fresnel(np.cos(np.radians(brewster)), 1.5)[0], 0)
c2 = np.sqrt(1 - (1 - c * c) / 1.5**2)
assert np.allclose(exact(c, 1.5), exact(c2, 1 / 1.5))  # the same share in both directions of one path

fig, axes = plt.subplots(1, 2, figsize=(9.6, 3.6), dpi=80, layout="constrained")
for eta, color, name in ((1.5, "C0", "air to glass"), (1 / 1.5, "C1", "glass to air")):
    axes[0].plot(angle, exact(c, eta), color=color, label=name)
    here = [(ray, child) for ray, child in branches if child.kind == "reflected" and ray.object == "in front" and ray.front == (eta > 1)]
    cosines = np.array([-unit(ray.direction) @ ray.shading_normal for ray, _ in here])
    shares = np.array([child.throughput[0] / ray.weight[0] for ray, child in here])
    axes[0].plot(np.degrees(np.arccos(cosines)), shares, ".", color=color)
    assert np.abs(shares - exact(cosines, eta)).max() < 1e-4 and len(here) > 5
axes[0].plot(angle, fresnel(c, 1.5)[0], "k:", linewidth=1, label=f"air to glass, parallel: 0 at {brewster:.1f} (Brewster)")
axes[0].plot(angle, fresnel(c, 1.5)[1], "k--", linewidth=1, label="air to glass, perpendicular")
axes[0].set(xlabel="angle of incidence, degrees", ylabel="share that is reflected", ylim=(0, 1.05))
axes[0].legend(fontsize=8)
for n in (1.1, 1.33, 1.5, 2.4):
    error = schlick(c, n) - exact(c, n)
    axes[1].plot(angle, error, label=f"n = {n:g}: from {error.min():.3f} to {error.max():.3f}")
axes[1].set(xlabel="angle of incidence, degrees", ylabel="Schlick minus exact")
axes[1].legend(fontsize=8)
plt.show()

# %% [markdown]
# Schlick is exact at 0 and 90 degrees, and wrong by a few hundredths in between. The default of wrt is the exact formula;
# `fresnel="schlick"` is a setting of the scene. The difference in a picture is at outlines (difference in radiance, white is 0.05):

# %%
balls = "../scenes/schlick.toml"
films = {name: wrt.render(balls, size=SIZE, spp=SPP, fresnel=name) for name in ("exact", "schlick")}
gap = np.abs(films["exact"].pixels - films["schlick"].pixels).max(axis=2)
wrt.side_by_side({"n = 1.1, 1.5 and 2.4, exact": films["exact"], f"difference, mean {gap.mean():.4f}": colored(gap, top=0.05)})

# %% [markdown]
# ## Beer and Lambert: colour by distance
# A layer of coloured glass absorbs a share of the light that is proportional to its thickness: $dL = -a L\,ds$. So the share
# $e^{-a d}$ of the light is left after the distance $d$, with one coefficient $a$ (per unit of length) for each colour. The dots are traced
# rays inside the prism: the weight of the light at their end over their throughput.

# %%
prism = next(thing for thing in wrt.load_scene("../scenes/glass_slab.toml").objects if thing.name == "prism")
coefficients = prism.materials[0].absorption
inside = [ray for ray in rays if ray.object == "prism" and not ray.front and np.isfinite(ray.t)]
length = np.array([ray.t * np.linalg.norm(ray.direction) for ray in inside])
left = np.array([ray.weight / ray.throughput for ray in inside])
assert len(inside) > 10 and np.abs(left - np.exp(-np.outer(length, coefficients))).max() < 1e-5
fig, ax = plt.subplots(figsize=(6.4, 3.0), dpi=80, layout="constrained")
d = np.linspace(0, 1.05 * length.max(), 100)
for a, color, values in zip(coefficients, ("C3", "C2", "C0"), left.T, strict=True):
    ax.plot(d, np.exp(-a * d), color=color, linewidth=1, label=f"a = {a:g} per unit")
    ax.plot(length, values, ".", color=color)
ax.set(xlabel="distance in the glass, units", ylabel="share of the light that is left", ylim=(0, 1.03))
ax.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## The whole tracer, by recursion
# These few lines are a Whitted tracer for balls of glass and of mirror under a sky. Light that enters glass is squeezed into a narrower
# cone; its radiance there would be larger by $n^2$. So the weight of a refracted ray is divided by $\eta^2$. The recursion is the tree
# itself:
#
# $$L(\text{ray}) = k_r\,L(\text{reflected}) + k_t\,L(\text{refracted}).$$

# %%
DEPTH = 8
world = replace(scene, objects=(), lights=(), spheres=scene.spheres[:2], ambient=(0, 0, 0))
top, bottom = np.array(world.background.top), np.array(world.background.bottom)


def nearest(o, d, spheres):
    """Return the distance and the ball of the first hit; (inf, None) on a miss."""
    best = np.inf, None
    for ball in spheres:
        m = o - np.array(ball.center)
        half, c = m @ d, m @ m - ball.radius**2
        if half * half > c:
            root = np.sqrt(half * half - c)
            t = next((t for t in (-half - root, -half + root) if t > 1e-6), np.inf)
            best = min(best, (t, ball), key=lambda pair: pair[0])
    return best


def hit(o, d, spheres):
    """Return the light at the first hit, and the new rays there as (weight, origin, direction)."""
    t, ball = nearest(o, d, spheres)
    if ball is None:
        return bottom + 0.5 * (d[1] + 1) * (top - bottom), []
    p = o + t * d
    outside = (p - np.array(ball.center)) / ball.radius
    front = d @ outside < 0
    n, albedo = outside if front else -outside, np.array(ball.material.albedo)
    mirrored = p, d - 2 * (d @ n) * n
    if ball.material.kind == "mirror":
        return np.zeros(3), [(albedo, *mirrored)]
    eta = ball.material.ior if front else 1 / ball.material.ior
    share, bent = exact(-d @ n, eta), refracted(d, n, eta)
    return np.zeros(3), [(share, *mirrored), *([] if bent is None else [((1 - share) * albedo / eta**2, p, bent)])]


def recursive(o, d, spheres, bounces):
    """Return the radiance along a ray with at most so many bounces."""
    light, new = hit(o, d, spheres)
    return light + sum(weight * recursive(*ray, spheres, bounces - 1) for weight, *ray in new if bounces > 0)


def by_stack(o, d, spheres, bounces):
    """Return the same, and the largest number of rays that wait. A ray waits with its throughput, and adds to one sum."""
    total, waiting, most = np.zeros(3), [(np.ones(3), o, d, bounces)], 1
    while waiting:
        throughput, o, d, bounces = waiting.pop()
        light, new = hit(o, d, spheres)
        total = total + throughput * light
        waiting += [(throughput * weight, *ray, bounces - 1) for weight, *ray in new if bounces > 0]
        most = max(most, len(waiting))
    return total, most


inspector = Inspector(world, spp=1, max_depth=DEPTH, min_throughput=0)
worst, most, count = np.zeros(2), 0, 0
for xy in rng.integers((220, 50), (420, 260), (PIXELS // 3, 2)):
    sample = inspector.pixel(tuple(xy.tolist()), 0).samples[0]
    o, d = sample.root.origin.astype(float), unit(sample.root.direction.astype(float))
    one, (two, here) = recursive(o, d, world.spheres, DEPTH), by_stack(o, d, world.spheres, DEPTH)
    worst = np.maximum(worst, [np.abs(one - two).max(), np.abs(one - sample.radiance).max()])
    most, count = max(most, here), max(count, len(sample.rays))
print(f"up to {count} rays a tree, at most {most} rays wait")
print(f"recursion minus stack: at most {worst[0]:.1e}; recursion minus wrt (float32): at most {worst[1]:.1e}")
assert worst[0] < 1e-12 and worst[1] < 1e-4 and most <= DEPTH + 1

# %% [markdown]
# The recursion is *linear*: the light of a ray is multiplied by all weights on its way to the camera, and added. So no ray has to wait for
# the result of another. A stack with the throughput of each waiting ray does the same work. Each turn takes one ray from the stack and
# puts at most two onto it: at most depth + 1 rays wait. A recursion of many levels fails where a stack does not; this ray runs to and fro
# between two mirror balls:

# %%
mirror = replace(world.spheres[1].material, albedo=(1, 1, 1))
facing = [replace(world.spheres[1], center=(0, 0, z), radius=1.0, material=mirror) for z in (-3, 3)]
ray = np.zeros(3), np.array([0.0, 0.0, 1.0])
try:
    recursive(*ray, facing, 20_000)
    raise AssertionError("the recursion should be too deep")
except RecursionError as error:
    print("recursion:", error)
print("stack: rays that wait:", by_stack(*ray, facing, 20_000)[1])

# %% [markdown]
# A GPU gives each of its many threads little memory for calls, so that renderers on GPUs use a stack, too. wrt has both loops:
# `kernels/loops/one_ray.py` takes one ray at a time, `kernels/loops/wave.py` thousands of them.
#
# ## What a cut loses
# Some trees never end: light in a glass ball is reflected again and again. wrt cuts a ray after `max_depth` bounces, and a ray whose
# throughput is below `min_throughput`. A cut ray adds nothing. So a picture with cuts is too dark: a *bias*, which no number of samples
# removes.
#
# In a *furnace*, every direction has the radiance 1. Clear glass only redistributes light, so every pixel is 1. What is missing is what
# was cut: 1 minus the mean pixel is the throughput of all cut rays. `film.stats` reports it, in every scene.

# %%
CUTS = {"max_depth": (0, 1, 2, 3, 4, 6, 8), "min_throughput": (0.5, 0.2, 0.05, 0.02, 0.005, 0.001)}
fig, axes = plt.subplots(1, 2, figsize=(9.6, 3.4), dpi=80, layout="constrained", sharey=True)
small = tuple(size // 2 for size in SIZE)
for ax, (name, values) in zip(axes, CUTS.items(), strict=True):
    rest = {"min_throughput": 0} if name == "max_depth" else {"max_depth": 64}
    films = [wrt.render("../scenes/furnace.toml", camera="glass", size=small, spp=SPP // 2, **{name: value}, **rest) for value in values]
    missing = np.array([1 - film.pixels.astype(float).mean() for film in films])
    lost = np.array([film.stats["lost_throughput_per_sample"] for film in films])
    assert np.abs(missing - lost).max() < 1e-5
    ax.plot(values, missing, "o", label="1 minus the mean pixel")
    ax.plot(values, lost, "k-", linewidth=1, label="throughput of the cut rays")
    for value, film, loss in zip(values, films, missing, strict=True):
        ax.annotate(f"{film.stats['rays_per_sample']:.1f}", (value, loss), (4, 5), textcoords="offset points", fontsize=8)
    ax.set(yscale="log", xlabel=name, xscale="linear" if name == "max_depth" else "log", title="numbers: rays per sample")
axes[0].set(ylabel="radiance that is lost, of 1")
axes[0].legend(fontsize=8)
plt.show()

# %% [markdown]
# Each bounce costs rays, and pays less than the bounce before. The picture: at depth 0 glass and mirrors are black, at depth 1 the glass
# ball has a black inside, and from depth 4 on only a few pixels change.

# %%
films = {f"depth {depth}": wrt.render(scene, size=small, spp=SPP, max_depth=depth) for depth in (0, 1, 2, 3, 4, 8)}
darker = [film.pixels.mean() for film in films.values()]
assert (np.diff(darker) >= -1e-7).all()  # a deeper tree only adds light
wrt.side_by_side({f"{title}, {film.stats['rays_per_sample']:.2f} rays a sample": film for title, film in films.items()}, columns=3)

# %% [markdown]
# ## Where does a new ray start?
# At its hit. But the hit point is rounded, and lies a little above or below the surface. A shadow ray from below hits the surface itself,
# so that lit points are dark (*shadow acne*). The usual remedy is to move the point outwards by a small $\varepsilon$. If it is too
# large, the ray starts behind a thin object close to the surface, and light leaks under it.
#
# The test scene has a floor, a ball, and a sheet that hovers 0.02 above the floor; the light is parallel. Which points are in shadow is
# known exactly. The scene is tested at four places and sizes.

# %%
LIGHT = np.array([0.45, 0.8, 0.4]) / np.linalg.norm([0.45, 0.8, 0.4])
HEIGHT, SHEET = 0.02, np.array([[-1.9, -0.7], [0.9, 1.9]])  # of the sheet: height, and ranges of x and z
PLACES = {"size 1": (1, 0), "size 1, 3000 away from 0": (1, 3000), "size 0.001": (0.001, 0), "size 1000": (1000, 0)}


def test_scene(scale, away):
    """Return the structure over floor, sheet and ball, and the rays of a camera."""
    (x0, x1), (z0, z1) = SHEET
    matte, move = world.spheres[0].material, np.array([away, 0, away])
    meshes = [quad(scale * np.array(corner) + move, scale * np.array(u), scale * np.array(v)) for corner, u, v in (
        ((-4, 0, 4), (8, 0, 0), (0, 0, -8)), ((x0, HEIGHT, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1)))]
    ball = wrt.Sphere(tuple(scale * np.array((0, 1, 0)) + move), scale, matte)
    accel = wrt.build(wrt.Scene(objects=tuple(wrt.Object(mesh, (matte,)) for mesh in meshes), spheres=(ball,)))
    camera = wrt.Camera.look_at(scale * np.array((-1.5, 1.9, 5.0)) + move, scale * np.array((-0.3, 0.55, 0)) + move, fov_y=np.radians(36))
    return accel, *wrt.camera_rays(camera, SIZE)


def true_shadow(p):
    """Return whether points (N, 3) of the scene of size 1 at 0 are in shadow, and whether that is certain."""
    m = p - (0, 1, 0)
    along = m @ LIGHT
    distance = np.linalg.norm(m - along[:, None] * LIGHT, axis=1)  # of the line to the light from the ball's centre
    on_ball = np.abs(np.linalg.norm(m, axis=1) - 1) < 1e-3
    at_sheet = p + ((HEIGHT - p[:, 1]) / LIGHT[1])[:, None] * LIGHT
    edge = np.concatenate([at_sheet[:, [0, 2]] - SHEET[:, 0], SHEET[:, 1] - at_sheet[:, [0, 2]]], axis=1).min(axis=1)
    below = p[:, 1] < 0.5 * HEIGHT
    dark = np.where(on_ball, along < 0, ((distance < 1) & (along < 0)) | (below & (edge > 0)))
    return dark, np.where(on_ball, np.abs(along) > 0.02, (np.abs(distance - 1) > 0.003) & (np.abs(edge) > 0.003))


def outside(point, error, normal):
    """Move points by the bound of their rounding error, per axis, along the normal, and round away from the surface."""
    offset = (error * np.abs(normal)).sum(axis=1, keepdims=True) * normal
    moved = point + offset
    return np.where(offset == 0, moved, np.nextafter(moved, np.where(offset > 0, np.inf, -np.inf).astype(np.float32)))


EPSILONS, wrong, pictures = np.geomspace(1e-8, 1.0, 17), {}, {}
for place, (scale, away) in PLACES.items():
    accel, o, d = test_scene(scale, away)
    hits = accel.closest_hit(o, d)
    seen = hits.prim_id >= 0
    n, p, error = hits.normal[seen], hits.point[seen], hits.point_error[seen]
    dark, certain = true_shadow((p.astype(float) - (away, 0, away)) / scale)
    certain &= n @ LIGHT > 0.02  # a surface that faces away from the light traces no shadow ray
    rounded = (o + hits.t[:, None] * d)[seen]
    starts = {eps: rounded + np.float32(eps) * n for eps in EPSILONS} | {"bound": outside(p, error, n)}
    found = {name: accel.any_hit(start, np.tile(LIGHT, (len(p), 1))) for name, start in starts.items()}
    wrong[place] = {name: ((result != dark) & certain).sum() / certain.sum() for name, result in found.items()}
    if place == "size 1":
        for name in (EPSILONS[2], EPSILONS[8], EPSILONS[14], "bound"):
            shade = np.full(len(o), 0.75)
            shade[seen] = 0.15 + 0.8 * np.maximum(n @ LIGHT, 0) * ~found[name]
            code = np.rint(255 * shade ** (1 / 2.2)).astype(np.uint8).reshape(SIZE[::-1])
            title = "the error bound" if name == "bound" else f"epsilon {name:.1e}"
            pictures[f"{title}: {wrong[place][name]:.2%} wrong"] = np.repeat(code[..., None], 3, axis=2)
wrt.side_by_side(pictures)

# %%
fig, ax = plt.subplots(figsize=(6.8, 3.4), dpi=80, layout="constrained")
for i, (place, shares) in enumerate(wrong.items()):
    ax.plot(EPSILONS, [100 * shares[eps] for eps in EPSILONS], "o-", color=f"C{i}", label=f"{place}; by the bound: {shares['bound']:.0%}")
    assert shares["bound"] == 0
ax.set(xscale="log", xlabel="epsilon, units", ylabel="% of the points that are wrong", ylim=(-1, None))
ax.legend(fontsize=8)
plt.show()
best = {place: [eps for eps in EPSILONS if shares[eps] == 0] for place, shares in wrong.items()}
for place, good in best.items():
    print(f"{place}: no wrong point for epsilons from {min(good):.1e} to {max(good):.1e}")
assert not set.intersection(*map(set, best.values()))  # no epsilon of the list suits all

# %% [markdown]
# The first picture has acne. In the third, the shadow of the sheet is gone, and the shadow of the ball has moved.
# A good $\varepsilon$ depends on the size of the scene and on the smallest gap between surfaces. None suits all scenes. With float32
# coordinates it would also depend on the distance from 0; wrt stores the scene that is 3000 away relative to a place near it
# (`accel.origin`), and its epsilons are those at 0. wrt uses no epsilon: it bounds the rounding error of *each* hit point
# (`hits.point_error`), and moves the new origin by that bound (Pharr, Jakob, Humphreys, "Physically Based Rendering", section 6.8). The
# bound has no parameter, and no point is wrong.
#
# ## Exercises
# **1.** A ray meets glass of $n = 1.5$ at 0 degrees. Which share of the light passes through a pane with two faces, if inner reflections
# are counted?
# <details><summary>Solution</summary>
#
# Each face reflects $F = 0.04$. The inner reflections are a geometric series: $(1-F)^2 (1 + F^2 + F^4 + \dots) = (1-F)^2/(1-F^2) =
# (1-F)/(1+F) = 0.923$. wrt's `thin` glass has the weight $1 - 2F/(1+F)$, which is the same number.
# </details>
#
# **2.** Two parallel mirrors of albedo $r$ face each other, and each also emits the radiance $e$. What does a camera between them see?
# How much does `max_depth` $= N$ lose?
# <details><summary>Solution</summary>
#
# $L = e + rL$, so $L = e/(1-r)$. With $N$ bounces the sum is $e(1 + r + \dots + r^N)$; the lost part is $r^{N+1}$ of $L$. For $r = 0.9$
# and $N = 8$, 39 % are lost.
# </details>
#
# **3.** Why can a ray that enters a ball of glass from outside always leave it?
# <details><summary>Solution</summary>
#
# The chord makes the same angle with the normals at both ends. Inside, this angle has the sine $\sin\theta_1/n < 1/n$ at the entry, so
# at the exit it is below the critical angle, too. In the plot of Snell's law, all total reflections belong to slab and prism.
# </details>
#
# **4.** `min_throughput` 0.001 loses at most how much radiance in a tree with 20 cut rays under a sky of radiance 0.5?
# <details><summary>Solution</summary>
#
# Each cut ray has a throughput below 0.001, and would have returned about 0.5: less than $20\cdot 0.001\cdot 0.5 = 0.01$.
# `film.stats["lost_throughput_per_sample"]` has the sum of the throughputs themselves.
# </details>
#
# **5.** Predict which epsilons are right at size 100, and at size 1, 3 million away from 0. Then add both to `PLACES`.
# <details><summary>Solution</summary>
#
# With the scene, all rounding errors and all gaps grow by the same factor: at size 100 the range of size 1 begins and ends 100 times
# higher. Far from 0, the range of size 1 stays, because coordinates are relative to `accel.origin`. The error bound is right in both.
# </details>
