#!/usr/bin/env bash
# Library:  mujoco-warp 4.0.0 (mujoco 4.0.0, warp-lang 1.19.0, NumPy 2.4.6).
# Expected: rays() returns the "distances from ray origins to geom surfaces", or -1 without a hit (its docstring). Here a box, as a mesh, has
#           its top at z = 0.5, and rays start 0.5 to 2.5 above the top, in the plane of a wall to within float32. So a distance is at least 0.5.
# Seen:     of 2,000 such rays 42 have the distance 0, with the wall's normal: the sensor seems to touch a wall that ends below it. Four more
#           have the distance of the bottom. The same mesh with mujoco.mj_ray (float64): no distance is wrong. _ray_triangle projects the
#           triangle along the ray, and accepts an edge-on projection down to a determinant of 1e-15; the plane's equation then divides two
#           rounded zeros.
# Matters:  a range sensor flush with a wall, a shelf or a seam of terrain tiles reads 0 where 1 m is free. A filter for misses (-1) keeps it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mujoco-warp==4.0.0 mujoco==4.0.0 warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
cat > "$folder/seen.py" <<'PYTHON'
import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.types import vec6f

wp.config.quiet = True
N = 2000
vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 0.5)])
quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
spec = mujoco.MjSpec()
spec.add_mesh(name="box", uservert=vertices.reshape(-1).tolist(), userface=np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).reshape(-1).tolist())
spec.worldbody.add_body().add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="box")
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)

rng = np.random.default_rng(0)
origins = np.column_stack([rng.uniform(0.1, 0.9, N), np.ones(N), rng.uniform(1, 3, N)]).astype(np.float32)
directions = np.column_stack([rng.uniform(0.1, 0.9, N), np.ones(N), np.full(N, 0.5)]) - origins
directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
directions[:, 1] += (rng.normal(size=N) * 1e-7).astype(np.float32)
top = (0.5 - origins[:, 2].astype(float)) / directions[:, 2]

with wp.ScopedDevice("cpu"):
    m, d = mjw.put_model(model), mjw.put_data(model, data)
    dist, geom, normal = wp.zeros((1, N), dtype=float), wp.zeros((1, N), dtype=int), wp.zeros((1, N), dtype=wp.vec3)
    rays = [wp.array(each[None], dtype=wp.vec3) for each in (origins, directions)]
    mjw.rays(m, d, *rays, vec6f(*[-1.0] * 6), True, wp.full(N, -1, dtype=int), dist, geom, normal)
there, normal = dist.numpy()[0], normal.numpy()[0]
here = np.array([mujoco.mj_ray(model, data, o.astype(float), v.astype(float), None, 1, -1, np.zeros(1, np.int32)) for o, v in zip(origins, directions)])

seen = []
for name, t in (("mujoco_warp.rays", there), ("mujoco.mj_ray", here)):
    wrong = (t >= 0) & (np.abs(t - top) > 1e-3)
    seen.append((int(wrong.sum()), int((wrong & (t == 0)).sum())))
    print(f"{name}: {seen[-1][0]} wrong distances of {N} rays, {seen[-1][1]} of them 0; {int((t < 0).sum())} misses")
for i in np.flatnonzero((there >= 0) & (np.abs(there - top) > 1e-3))[:4]:
    print("origin", origins[i], "distance to the top", round(top[i], 4), "returned", round(float(there[i]), 4), "normal", normal[i])
assert seen == [(46, 42), (0, 0)], seen
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
