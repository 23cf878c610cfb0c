# %% [markdown]
# # From a ray to a picture: pinhole, lens, depth of field
# To render a picture is to find what the ray through each pixel meets first. This notebook does it step by step in NumPy, then by
# `wrt.render`. After that, a lens replaces the pinhole, and the blur of the lens is predicted and measured.
#
# All shapes are made by formulas or come from `../scenes`. If the environment variable `WRT_QUICK` is set, pictures are smaller and have
# fewer samples. The outputs below were made without it.

# %%
import os
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import wrt
from wrt.picture.heatmap import heatmap
from wrt.scene.shapes import merged, quad, teapot

QUICK = "WRT_QUICK" in os.environ
SIZE, SPP = ((160, 90), 4) if QUICK else ((480, 270), 64)

# %% [markdown]
# ## One ray
# A ray is an origin $o$ and a direction $d$; its points are $o + t\,d$ with $t \ge 0$. An acceleration structure over a mesh finds the
# first triangle that a ray meets. It returns `prim_id` (the index of the triangle), $t$, and the barycentric coordinates $u$ and $v$ of
# the hit point $(1-u-v)\,v_0 + u\,v_1 + v\,v_2$.

# %%
mesh = merged([quad((-3, 0, 3), (6, 0, 0), (0, 0, -6)), teapot(64)], "pot on a floor")
accel = wrt.build(mesh)
hits = accel.closest_hit([[0.0, 0.4, 3.0]], [[0.0, 0.0, -1.0]])
t, prim_id, u, v = (array[0] for array in (hits.t, hits.prim_id, hits.u, hits.v))
v0, v1, v2 = mesh.vertices[mesh.faces[prim_id]]
print(f"triangle {prim_id} of {len(mesh.faces)} at t = {t:.4f}")
print("by the ray:     ", np.round([0.0, 0.4, 3.0 - t], 4))
print("by the triangle:", np.round((1 - u - v) * v0 + u * v1 + v * v2, 4))

# %% [markdown]
# ## One ray per pixel
# All rays of a pinhole camera start at one point. The ray of a pixel goes through the pixel's centre on a screen at distance 1. The
# vertical angle of view gives the height of the screen, $2\tan(\mathrm{fov}_y/2)$. `camera_rays` returns one ray per pixel.

# %%
camera = wrt.Camera.look_at((1.3, 1.5, 2.6), (0.05, 0.4, 0.0), fov_y=np.radians(32))
origins, directions = wrt.camera_rays(camera, SIZE)
hits = accel.closest_hit(origins, directions)
hits

# %%
def picture(values):
    return values.reshape(SIZE[1], SIZE[0], *values.shape[1:])


hit = hits.prim_id >= 0
depth = np.where(hit, hits.t, 0.0)
wrt.side_by_side({"": heatmap(picture(depth), "distance to the hit (0: none)")})

# %% [markdown]
# This cell checks the angle of view. The angle between the first and the last ray of the middle column, plus half a pixel at each end,
# must be `fov_y`.

# %%
column = picture(directions)[:, SIZE[0] // 2].astype(np.float64)
seen = np.degrees(np.arccos(column[0] @ column[-1]))
step = np.degrees(np.arccos(column[0] @ column[1]))
print(f"first to last pixel centre: {seen:.3f} degrees; and half a pixel at each end: {seen + step:.2f}")

# %% [markdown]
# ## Light by hand
# The radiance of a matte surface is proportional to the cosine between its normal and the light, unless an object blocks the light. To
# find out, trace one more ray, the shadow ray, from the hit to the light. It must not start on the surface itself, because the hit point
# is rounded. Here it starts $10^{-4}$ above the surface, which suits this scene but not a scene of another size. (`wrt.render` offsets it
# by a bound on the rounding error instead.)

# %%
corners = mesh.vertices[mesh.faces]
normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
normals /= np.linalg.norm(normals, axis=1, keepdims=True)

normal = normals[hits.prim_id[hit]]
facing = (normal * directions[hit]).sum(axis=1, keepdims=True) < 0.0
normal = np.where(facing, normal, -normal)
points = origins[hit] + hits.t[hit, None] * directions[hit] + 1e-4 * normal

light = np.array([2.0, 4.0, 1.5])
shadow_rays = light - points
dark = accel.any_hit(points, shadow_rays, t_max=1.0)  # t = 1 is the light itself
cosine = np.maximum((normal * shadow_rays).sum(axis=1) / np.linalg.norm(shadow_rays, axis=1), 0.0)

color = np.full((len(hit), 3), (0.55, 0.68, 0.90))
on_floor = hits.prim_id[hit] < 2
paint = np.where(on_floor[:, None], (0.75, 0.72, 0.66), (0.80, 0.30, 0.20))
color[hit] = paint * (0.12 + 0.88 * np.where(dark, 0.0, cosine))[:, None]
by_hand = (255.0 * picture(color) ** (1 / 2.2)).astype(np.uint8)
print(f"{hit.sum()} of {len(hit)} rays hit; {dark.sum()} of the hits lie in shadow")
wrt.side_by_side({"by hand": by_hand})

# %% [markdown]
# That is a ray tracer, with two flaws. The triangles are visible, because each has one normal. Edges have steps, because each pixel has
# one ray.

# %% [markdown]
# ## Many rays per pixel
# `wrt.render` averages `spp` rays per pixel. The pixel filter spreads them evenly over the pixel and a little beyond. `wrt.render` also
# has normals that vary over a triangle, mirrors, glass, and lights of every kind. The pictures show the pot of `scenes/lens.toml`,
# magnified so that each pixel is a square:

# %%
night = wrt.load_scene("../scenes/lens.toml")
crop = tuple(round(x * SIZE[0] / 480) for x in (160, 158, 230, 208))
wrt.side_by_side({f"{spp} ray{'s' * (spp > 1)} per pixel": wrt.render(night, camera="pinhole", size=SIZE, spp=spp, crop=crop)
                  for spp in (1, 4, SPP)}, columns=3, scale=4)

# %% [markdown]
# ## From the pinhole to the lens
# A real camera needs light, and so has a wide aperture with a lens. A thin lens of focal length $f$ focuses light from a point at
# distance $s$ onto a point at distance $s'$ behind the lens, where $1/s + 1/s' = 1/f$. The sensor is at this distance. So all rays of a
# pixel pass through one point of the plane in focus, wherever they cross the lens. Points nearer or farther are blurred. `Camera.lens`
# converts a photographer's settings to the parameters of wrt's camera.

# %%
pinhole = night.camera("pinhole")
lens = night.camera("round")
print({name: round(value, 4) for name, value in
       wrt.Camera.lens(focal_length=0.9, focus_distance=6.0, sensor_height=0.40, f_number=2.25).items()})
film = wrt.render(night, camera=lens, size=SIZE, spp=2 * SPP)
wrt.side_by_side({"pinhole": wrt.render(night, camera=pinhole, size=SIZE, spp=SPP), "lens, f / 2.25, focused at 6": film})

# %% [markdown]
# ### Three rays that find the image
# A thin lens changes the slope of a ray by $-h/f$, where $h$ is the height at which the ray crosses the lens. Three rays of a point are
# easy to draw:
# - The **chief ray** crosses the middle of the lens, $h = 0$, and goes straight on.
# - The **parallel ray** arrives parallel to the axis, and leaves through the focal point behind the lens.
# - The **focal ray** comes through the focal point in front of the lens, and leaves parallel to the axis.
#
# They meet at the image of the point; so do all other rays of the point, as the cell checks.

# %%
f, s, y = 1.0, 3.0, 0.6
image = 1 / (1 / f - 1 / s)  # s'
fig, axes = plt.subplots(1, 2, figsize=(11.0, 3.2), dpi=80, layout="constrained")
for ax in axes:
    ax.annotate("", (0, 1.0), (0, -1.0), arrowprops={"arrowstyle": "<->", "color": "C0", "lw": 1.6})
    ax.axhline(0, color="0.8", linewidth=0.8)
    ax.plot([-f, f], [0, 0], "k|")
for name, h, color in (("chief ray", 0.0, "C3"), ("parallel ray", y, "C2"), ("focal ray", -y * image / s, "C1"),
                       ("another ray", -0.75, "0.6"), ("another ray", 0.3, "0.6")):
    slope = (h - y) / s
    behind = slope - h / f
    assert np.isclose(h + image * behind, -y * image / s)  # the image is upside down, s'/s times as large
    axes[0].plot([-s, 0, 1.4 * image], [y, h, h + 1.4 * image * behind], color=color, label=None if h == 0.3 else name)
axes[0].plot([-s, image], [y, -y * image / s], "ko", markersize=4)
axes[0].text(-f, 0.06, "f"), axes[0].text(f, 0.06, "f"), axes[0].text(image + 0.08, -0.3, "image")
axes[0].legend(fontsize=8, loc="upper right")
axes[0].set(title=f"a point at s = {s:g} and its image at s' = {image:g}", xlabel="along the axis, units", ylabel="height, units",
            ylim=(-1.1, 1.1))

S = np.array([-image, 0.25])  # the camera traces from the sensor, which stands at s'
P = np.array([s, -S[1] * s / image])
for h in np.linspace(-0.8, 0.8, 5):
    slope = (h - S[1]) / image - h / f
    assert np.isclose(h + s * slope, P[1])  # through the lens, every ray from S goes to P
    axes[1].plot([S[0], 0, 1.5 * s], [S[1], h, h + 1.5 * s * slope], color="C3" if h == 0 else "C4", linewidth=1.6 if h == 0 else 1.0)
axes[1].axvline(-image, color="0.3"), axes[1].axvline(s, color="0.6", linestyle=":")
for name, x, height in (("S", S[0] - 0.3, S[1]), ("L", 0.08, 0.85), ("P", P[0] + 0.06, P[1] - 0.3), ("sensor", -image + 0.06, -1.0),
                        ("in focus", s + 0.06, 0.85)):
    axes[1].text(x, height, name)
axes[1].set(title="from S on the sensor by L on the lens to P", xlabel="along the axis, units", xlim=(-2.1, 4.6), ylim=(-1.1, 1.1))
plt.show()

# %% [markdown]
# The right picture is what a camera of wrt does, from left to right. The chief ray (red) from the point $S$ of the sensor gives the point
# $P$ in the plane in focus. The ray of a sample starts at a random point $L$ of the lens, and goes to $P$. So the sensor itself is never
# needed. The next cell inspects the rays that wrt traces for one pixel (`wrt.inspect`), in the camera's coordinates. Their origins are
# points $L$; their distances from the chief ray follow $r\,|z - s| / s$, apart from the width of the pixel.

# %%
samples = wrt.inspect(night, (240, 60), camera=lens, spp=32, size=(480, 270), max_depth=0).samples
rotation, eye = lens.camera_to_world[:3, :3], lens.camera_to_world[:3, 3]
starts = np.array([(sample.root.origin - eye) @ rotation for sample in samples])
toward = np.array([sample.root.direction @ rotation for sample in samples])
toward /= -toward[:, 2:]  # one unit along the axis
assert np.abs(starts[:, 2]).max() < 1e-5 and np.hypot(starts[:, 0], starts[:, 1]).max() <= lens.aperture_radius * (1 + 1e-5)
fig, ax = plt.subplots(figsize=(7.2, 2.8), dpi=80, layout="constrained")
z = np.linspace(0, 14, 57)
across = starts[:, :1] + toward[:, :1] * z
ax.plot(z, across.T, color="C4", linewidth=0.6)
center, r = across.mean(axis=0), lens.aperture_radius
for sign in (-1, 1):
    ax.plot(z, center + sign * r * np.abs(z - lens.focus_distance) / lens.focus_distance, "k--", linewidth=1,
            label="$r\\,|z - s|\\,/\\,s$" if sign == 1 else None)
ax.axvline(lens.focus_distance, color="0.6", linestyle=":")
ax.set(xlabel="distance along the axis, units (in focus: 6)", ylabel="x, units")
ax.legend(fontsize=8)
plt.show()
footprint = 2 * lens.focus_distance * np.tan(0.5 * lens.fov_y) / 270  # of a pixel, in the plane in focus
in_focus = np.ptp(across[:, np.argmin(np.abs(z - lens.focus_distance))])
print(f"in focus, the rays of a pixel are {in_focus / footprint:.1f} pixels wide (the pixel filter), at the lens {2 * r / footprint:.0f}")
assert in_focus < 5 * footprint

# %% [markdown]
# ## How large is the blur?
# Light from a point at distance $z$ reaches a lens of radius $r$ in a cone. In the plane in focus, at distance $s$, this cone has the
# diameter $2 r\,|z - s| / z$ (similar triangles). The picture's height $H$, in pixels, covers the length $2 s \tan(\mathrm{fov}_y/2)$ of
# that plane. So the diameter of the blur is
#
# $$c = \frac{2 r\,|z-s|}{z}\cdot\frac{H}{2 s\tan(\mathrm{fov}_y/2)}\ \text{pixels}.$$
#
# To test the formula, one small lamp is rendered at several distances. A disc of diameter $c$ has the variance $c^2/16$ along an axis,
# and variances add. A second picture, through a pinhole, has the variance of the lamp's own size and of the pixel filter. Subtracting it
# leaves the variance of the blur.

# %%
side = SIZE[1]
steel, lamp = night.spheres[:2]
bright = replace(lamp.material, emission=(1000, 1000, 1000))
away = np.eye(4)
away[2, 3] = 100.0  # behind the camera
pot = replace(night.objects[1], transform=away)
position, axis = lens.camera_to_world[:3, 3], -lens.camera_to_world[:3, 2]


def spread(camera, z, spp):
    """Return the variance along an image axis, in pixels^2, of the picture of a lamp at distance z."""
    here = replace(lamp, center=position + z * axis, radius=0.004 * z, material=bright)
    scene = replace(night, objects=(pot,), spheres=(replace(steel, center=away[:3, 3]), here))
    light = wrt.render(scene, camera=camera, size=(side, side), spp=spp).pixels[..., 0].astype(np.float64)
    light = np.where(light > 2.0, light, 0.0)  # nothing but the lamp is so bright
    y, x = np.mgrid[:side, :side]
    mean_x, mean_y = (light * x).sum() / light.sum(), (light * y).sum() / light.sum()
    return 0.5 * (light * ((x - mean_x) ** 2 + (y - mean_y) ** 2)).sum() / light.sum()


def blur(z):
    r, s = lens.aperture_radius, lens.focus_distance
    return 2.0 * r * np.abs(z - s) / z * side / (2.0 * s * np.tan(0.5 * lens.fov_y))


sharp = replace(lens, aperture_radius=1e-6)
distances = np.array([3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 24.0])
measured = np.array([4.0 * np.sqrt(max(spread(lens, z, 2 * SPP) - spread(sharp, z, SPP), 0.0)) for z in distances])

fig, ax = plt.subplots(figsize=(6.4, 3.4), dpi=80, layout="constrained")
z = np.linspace(2.6, 26.0, 400)
ax.plot(z, blur(z), color="0.4", label="predicted")
ax.plot(distances, measured, "o", color="C3", label="measured in the picture")
ax.set(xlabel="distance of the lamp along the axis", ylabel="diameter of the blur, pixels", xlim=(2, 26))
ax.legend()
plt.show()
for z, m in zip(distances, measured, strict=True):
    print(f"z = {z:4.0f}: predicted {blur(z):5.2f}, measured {m:5.2f} pixels")

# %% [markdown]
# ## What a photographer sets
# The f-number is $N = f / (2r)$: a larger f-number is a smaller aperture. Twice the f-number halves the blur at every distance. Focusing
# moves the plane that is sharp. The blur of distant objects hardly depends on their distance, because $|z-s|/z$ approaches 1.

# %%
def photo(f_number, focus_distance):
    spp = 2 * SPP if f_number < 4.0 else SPP  # a wider aperture needs more samples
    setting = wrt.Camera.lens(0.9, focus_distance, 0.40, f_number=f_number)
    return wrt.render(night, camera=replace(lens, **setting), size=tuple(x * 2 // 3 for x in SIZE), spp=spp)


wrt.side_by_side({f"f / {n:g}, focused at {s:g}": photo(n, s)
                  for n, s in ((2.25, 4.8), (2.25, 6.0), (2.25, 10.4), (4.5, 6.0), (9.0, 6.0), (18.0, 6.0))}, columns=3)

# %% [markdown]
# The picture of a lamp out of focus has the shape of the aperture. Six straight blades (`blades=6`) make hexagons. For a lamp behind the
# plane in focus, the shape is upright; for a lamp in front of the plane, it is rotated by half a turn. Three blades show the difference
# (here the camera focuses at 7 units).

# %%
def lamps(spp, **blades):
    crop = tuple(round(x * SIZE[0] / 480) for x in (0, 0, 160, 110))
    return wrt.render(night, camera=replace(lens, focus_distance=7.0, **blades), size=SIZE, spp=spp, crop=crop)


wrt.side_by_side({"round": lamps(4 * SPP), "three blades": lamps(4 * SPP, blades=3), "six blades": lamps(4 * SPP, blades=6)},
                 columns=3, scale=2)

# %% [markdown]
# ## Exercises
# **1.** In "Light by hand", remove the offset of $10^{-4}$. Which pixels change, and why not all of them?
# <details><summary>Solution</summary>
#
# Lit points become dark in a pattern: those whose rounded hit point lies below its triangle, so that the shadow ray hits this triangle
# at once. A point that was rounded upwards starts above it. [whitted](whitted.ipynb) measures how large the offset may be.
# </details>
#
# **2.** Use varying normals in the picture that is shaded by hand. `mesh.normals` is None for `pot on a floor`, but `teapot().normals` is
# not. The normal at a hit is the mean of the normals at the three corners, with the weights $1-u-v$, $u$ and $v$.
# <details><summary>Solution</summary>
#
# The pot's faces follow the two of the floor: `n = teapot(64).normals[teapot(64).faces[prim_id - 2]]` has the shape (N, 3, 3).
# `smooth = (weights[:, :, None] * n).sum(axis=1)`, with the three weights of each hit, then divided by its length. Use `smooth` for the
# cosine, and the normal of the triangle for the offset.
# </details>
#
# **3.** At which f-number is the lamp at distance 24 blurred by one pixel? Predict it, then measure it.
# <details><summary>Solution</summary>
#
# The diameter is proportional to $r = f/(2N)$. So $N = 2.25\,$`blur(24.0)`, about 80. To measure it, use
# `replace(lens, aperture_radius=0.9 / (2 * N))` in `spread`.
# </details>
#
# **4.** `Camera.lens` lets `fov_y` depend on `focus_distance` ("focus breathing"). By how much does it change from 4.8 to 10.4?
# <details><summary>Solution</summary>
#
# The sensor stands at $s' = fs/(s-f)$: 1.108 for 4.8, and 0.985 for 10.4. $\mathrm{fov}_y = 2\arctan(0.40/(2s'))$ is 20.5 and 23.0
# degrees: 2.5 degrees more.
# </details>
