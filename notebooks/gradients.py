# %% [markdown]
# # Fitting to depth pictures
# A hit answers *where*; its derivatives answer *what would move it*. At a fixed triangle, t, u, v and the point of a hit are
# smooth functions of the triangle's corners and of the ray, with derivatives in closed form: `hits.gradients` takes the
# derivatives of a number by the hits and gives those by vertices, origins and directions. Here they fit first the pose of a
# teapot, then the shape of a ball, to pictures of depth. NumPy is enough; the last section has the same with torch.
#
# With `WRT_QUICK` in the environment, pictures are smaller and steps fewer; the outputs below are of the full setting.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import factorized
from scipy.spatial.transform import Rotation

import wrt
from wrt.scene import shapes

QUICK = "WRT_QUICK" in os.environ
SIZE = (48, 36) if QUICK else (128, 96)


def depth_of(accel, rays):
    hits = accel.closest_hit(*rays)
    return hits, np.where(hits.prim_id >= 0, hits.t, np.nan)


def show(*pictures, colors="viridis", **limits):
    figure, axes = plt.subplots(1, len(pictures), figsize=(3.2 * len(pictures), 2.7), dpi=80, layout="constrained")
    for axis, (title, picture) in zip(axes, pictures, strict=True):
        shown = axis.imshow(picture.reshape(SIZE[::-1]), cmap=colors, **limits)
        axis.set_title(title)
        axis.axis("off")
    figure.colorbar(shown, ax=axes, shrink=0.8)
    plt.show()


# %% [markdown]
# ## A pose
# The picture is of a teapot in a pose that we then forget. It is 2 long; we begin 17 degrees and 0.15 off.

# %%
teapot = shapes.teapot()
center = teapot.vertices.mean(axis=0)
body = teapot.vertices - center
camera = wrt.Camera.look_at((1.35, 1.25, 1.9), (0.06, 0.3, 0.0))
rays = wrt.camera_rays(camera, SIZE)


def placed(turn, shift):
    return np.float32(turn.apply(body) + center + shift)


accel = wrt.build((placed(Rotation.identity(), 0.0), teapot.faces))
_, target = depth_of(accel, rays)
turn, shift = Rotation.from_rotvec([0.15, 0.2, -0.15]), np.array([0.10, -0.06, 0.10])
accel.refit(placed(turn, shift))
_, before = depth_of(accel, rays)
show(("the picture", target), ("where we begin", before))

# %% [markdown]
# Each step asks for the depth and compares: the number to be made small is the mean square difference, over the pixels in which
# both pictures have the teapot. Its derivative by each hit is `2 (t - target) / count`; `hits.gradients` carries it to the
# vertices, and the chain rule to the pose: a shift moves all vertices alike, a turn about the center moves a vertex `x` by `w x
# (x - center)`. Moving the vertices is `accel.refit`, which keeps the tree and takes a fraction of the time of a build. The
# steps are Adam's.

# %%
class Adam:
    def __init__(self, rate, shape):
        self.rate, self.mean, self.square, self.n = rate, np.zeros(shape), np.zeros(shape), 0

    def step(self, gradient):
        self.n += 1
        self.mean += 0.2 * (gradient - self.mean)
        self.square += 0.05 * (gradient**2 - self.square)
        mean, square = self.mean / (1.0 - 0.8**self.n), self.square / (1.0 - 0.95**self.n)
        return self.rate * mean / (np.sqrt(square) + 1e-12)


def loss_and_gradient(accel, rays, target):
    hits, depth = depth_of(accel, rays)
    off = np.nan_to_num(depth - target)
    count = np.isfinite(depth - target).sum()
    return (off**2).sum() / count, hits.gradients(t=2.0 * off / count).vertices


errors, steps = [], 40 if QUICK else 120
adam = Adam(0.02, 6)
for i in range(steps):
    vertices = placed(turn, shift)
    accel.refit(vertices)
    loss, by_vertices = loss_and_gradient(accel, rays, target)
    errors.append((np.sqrt(loss), turn.magnitude(), np.linalg.norm(shift)))
    by_turn = np.cross(vertices - center - shift, by_vertices).sum(axis=0)
    adam.rate = 0.02 * (1.0 - i / steps)
    step = adam.step(np.concatenate([by_turn, by_vertices.sum(axis=0)]))
    turn, shift = Rotation.from_rotvec(-step[:3]) * turn, shift - step[3:]

accel.refit(placed(turn, shift))
_, after = depth_of(accel, rays)
show(("off before", before - target), ("off after", after - target), colors="RdBu", vmin=-0.2, vmax=0.2)
plt.figure(figsize=(6.0, 2.8), dpi=80)
for values, name in zip(np.array(errors).T, ("depth, root mean square", "turn, radians", "shift"), strict=True):
    plt.semilogy(values, label=name)
plt.xlabel("step")
plt.ylabel("error")
plt.legend()
plt.show()
print(f"off by {np.degrees(turn.magnitude()):.0e} degrees and {np.linalg.norm(shift):.0e} of length;"
      f" at the beginning {np.degrees(errors[0][1]):.1f} and {errors[0][2]:.2f}")
assert errors[-1][0] < 0.5 * errors[0][0]

# %% [markdown]
# What the derivatives do not know is the outline: `prim_id` is fixed, so a pixel that only one of the pictures has pulls at
# nothing. Where most of a picture is inside of the outline, as here, that does no harm; a fit from far away needs a term for
# outlines too.
#
# ## A shape
# Now each vertex moves by itself: a ball becomes the body of six depth pictures, from six sides. Pictures say nothing about
# vertices between their rays, and little along the surface; so each gradient is smoothed over the mesh before it is a step
# (Nicolet, Jacobson and Jakob 2021, *Large Steps in Inverse Rendering of Geometry*): a linear system with the mesh's Laplacian.

# %%
def knobbly(mesh):
    x, y, z = mesh.vertices.T
    radius = 0.9 + 0.18 * np.sin(4.0 * x + 1.0) * np.sin(3.0 * y) + 0.12 * np.cos(5.0 * z)
    return np.float32(mesh.vertices * radius[:, None])


body, ball = shapes.icosphere(4), shapes.icosphere(2 if QUICK else 3)
sides = np.concatenate([np.eye(3), -np.eye(3)]) * 3.2
views = [wrt.camera_rays(wrt.Camera.look_at(side, (0, 0, 0), up=np.roll(side, 1)), SIZE) for side in sides]
truth = wrt.build((knobbly(body), body.faces))
targets = [depth_of(truth, rays)[1] for rays in views]

corners = ball.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
edges = coo_array((np.ones(corners.shape[1]), tuple(corners)), shape=(len(ball.vertices),) * 2).tocsr()
smoothed = factorized((diags_array(1.0 + 4.0 * edges.sum(axis=1)) - 4.0 * edges).tocsc())  # 1 + 4 times the Laplacian

fit = wrt.build((0.9 * ball.vertices, ball.faces))
vertices = fit.geometry.vertices.astype(np.float64)
first, errors, steps = [depth_of(fit, rays)[1] for rays in views], [], 8 if QUICK else 80
for _ in range(steps):
    fit.refit(vertices, rebuild_at=2.0)
    losses, gradients = zip(*(loss_and_gradient(fit, *each) for each in zip(views, targets, strict=True)), strict=True)
    errors.append(np.sqrt(np.mean(losses)))
    move = smoothed(sum(gradients))
    vertices -= 0.5 * move / np.abs(move).max() * min(0.1, errors[-1])

fit.refit(vertices)
last = [depth_of(fit, rays)[1] for rays in views]
show(("off before", first[0] - targets[0]), ("off after", last[0] - targets[0]), colors="RdBu", vmin=-0.25, vmax=0.25)
show(("off before, from behind", first[3] - targets[3]), ("off after, from behind", last[3] - targets[3]), colors="RdBu",
     vmin=-0.25, vmax=0.25)
print(f"depth off by {errors[0]:.3f} before, {errors[-1]:.4f} after {steps} steps (root mean square)")
assert errors[-1] < 0.7 * errors[0]

# %%
def shaded(accel, rays):
    hits = accel.closest_hit(*rays)
    facing = -(hits.normal * rays[1]).sum(axis=1) / np.linalg.norm(rays[1], axis=1)
    return np.where(hits.prim_id >= 0, facing, 0.0)


start = wrt.build((0.9 * ball.vertices, ball.faces))
aslant = wrt.camera_rays(wrt.Camera.look_at((1.9, 1.4, 2.2), (0.0, 0.0, 0.0)), SIZE)
show(("the ball", shaded(start, aslant)), ("fitted", shaded(fit, aslant)), ("the body", shaded(truth, aslant)), colors="gray",
     vmin=0.0, vmax=1.0)

# %% [markdown]
# ## With torch, JAX or a tape of Warp
# The same derivatives stand behind `wrt.torch.closest_hit` (extra `torch`), which follows the vertices by itself:
#
# ```python
# vertices = torch.tensor(ball.vertices, requires_grad=True)
# optimizer = torch.optim.Adam([vertices], lr=0.01)
# for _ in range(100):
#     hits = wrt.torch.closest_hit(accel, vertices, origins, directions)
#     both = (hits.prim_id >= 0) & torch.isfinite(target)
#     loss = (hits.t[both] - target[both]).square().mean()
#     optimizer.zero_grad()
#     loss.backward()
#     optimizer.step()
# ```
#
# `wrt.jax.closest_hit` is the same under `jax.grad` and `jax.jit`. While a `wp.Tape` records, `accel.refit(points)` and
# `accel.closest_hit(origins, directions)` with Warp arrays that require gradients are on it.
