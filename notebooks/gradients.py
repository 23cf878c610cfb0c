# %% [markdown]
# # Fitting to depth pictures
# At a fixed triangle, t, u, v and the point of a hit are smooth functions of the triangle's corners and of the ray. Their derivatives
# have a closed form. `hits.gradients` takes the derivatives of a loss by the hits, and returns its derivatives by vertices, origins and
# directions. Here they fit first the pose of a teapot, then the shape of a ball, to depth pictures. This needs only NumPy; the last
# section uses torch.
#
# If the environment variable `WRT_QUICK` is set, pictures are smaller and steps fewer. The outputs below were made without it.

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
# The target picture shows a teapot of length 2 in an unknown pose. The fit starts from a pose that is 17 degrees and 0.15 units off.

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
# Each step computes the depth picture and the loss: the mean square difference over the pixels in which both pictures show the teapot.
# The derivative of the loss by the t of a hit is `2 (t - target) / count`. `hits.gradients` turns it into derivatives by the vertices.
# The chain rule leads to the pose. A shift moves all vertices alike. A small rotation vector `w` about the center moves a vertex `x` by
# the cross product of `w` and `x - center`. The optimizer is Adam. `accel.refit` moves the vertices; it keeps the tree and takes a
# fraction of the time of a build.

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
# The derivatives do not contain changes of the outline, because `prim_id` is fixed. A pixel that shows the teapot in only one of the two
# pictures adds nothing to the gradient. Here most of the teapot's pixels are in both pictures, so this does no harm. A fit that starts
# farther away needs another term for outlines.
#
# ## A shape
# Now each vertex moves independently: a ball is fitted to six depth pictures of a body, from six sides. The pictures say nothing about
# vertices between their rays, and little about motion along the surface. So a linear system with the mesh's Laplacian smooths each
# gradient over the mesh before the step (Nicolet, Jacobson and Jakob 2021, *Large Steps in Inverse Rendering of Geometry*).

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
# The function `wrt.torch.closest_hit` (extra `torch`) uses the same derivatives. Each call refits the structure to the vertices:
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
# `wrt.jax.closest_hit` does the same under `jax.grad` and `jax.jit`. A `wp.Tape` records `accel.refit(points)` and
# `accel.closest_hit(origins, directions)` with Warp arrays that require gradients.
