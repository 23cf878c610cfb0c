#!/usr/bin/env bash
# Library:  mujoco-warp 4.0.0 (mujoco 4.0.0, warp-lang 1.19.0, NumPy 2.4.6).
# Expected: a render context accelerates rays() ("BVH information for BVH accelerated ray intersections", its docstring). So distances are
#           those without one, and those of mujoco.mj_ray: a height field is a solid with walls and a base, of which the fourth number of
#           its size is the thickness (MuJoCo's XML reference). Here rays look at a pit with high borders, from above, the side and below.
# Seen:     with a context, all 2,000 rays at the surface are right, and all 6,000 rays at the walls, at the sides of the base and at its
#           bottom are wrong: a miss, or the surface behind the wall. Without a context, none is wrong. build_hfield_bvh makes triangles of
#           the upper surface only, and rays() culls their backs.
# Matters:  a robot's range sensor looks through the side of a step, a ramp or a terrain tile, as soon as the faster way is chosen.
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
XML = """<mujoco>
  <asset><hfield name="hill" nrow="3" ncol="3" size="1 1 0.5 0.3" elevation="1 1 1  1 0 1  1 1 1"/></asset>
  <worldbody>
    <geom type="hfield" hfield="hill" pos="0 0 1"/>
    <camera name="eye" pos="0 0 5"/>
  </worldbody>
</mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)

rng = np.random.default_rng(0)
x, y = rng.uniform(-0.95, 0.95, (2, N))
start, end = np.full(N, 3.0), np.zeros(N)
groups = {  # name: where rays start, and the point that they look at
    "surface": (np.column_stack([x, y, start]), np.column_stack([x, y, end])),
    "wall": (np.column_stack([start, x, 1.0 + rng.uniform(0.05, 0.45, N)]), np.column_stack([0 * x, x, np.full(N, 1.4)])),
    "side of the base": (np.column_stack([start, x, 1.0 - rng.uniform(0.05, 0.25, N)]), np.column_stack([0 * x, x, np.full(N, 0.85)])),
    "bottom of the base": (np.column_stack([x, y, end]), np.column_stack([x, y, start])),
}
seen = {}
with wp.ScopedDevice("cpu"):
    m, d = mjw.put_model(model), mjw.put_data(model, data)
    context = mjw.create_render_context(model, 1, (8, 8))
    mjw.refit_bvh(m, d, context)
    for name, (origins, ends) in groups.items():
        origins = origins.astype(np.float32)
        directions = ends - origins
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        truth = np.array([mujoco.mj_ray(model, data, o.astype(float), v.astype(float), None, 1, -1, np.zeros(1, np.int32))
                          for o, v in zip(origins, directions)])
        wrong = []
        for rc in (None, context):
            dist, geom, normal = wp.zeros((1, N), dtype=float), wp.zeros((1, N), dtype=int), wp.zeros((1, N), dtype=wp.vec3)
            rays = [wp.array(each[None], dtype=wp.vec3) for each in (origins, directions)]
            mjw.rays(m, d, *rays, vec6f(*[-1.0] * 6), True, wp.full(N, -1, dtype=int), dist, geom, normal, rc)
            wrong.append(int((np.abs(dist.numpy()[0] - truth) > 1e-3).sum()))
        seen[name] = int((truth >= 0).sum()), *wrong
        print(f"{name}: mj_ray hits with {seen[name][0]} of {N} rays; wrong without a context: {wrong[0]}, with: {wrong[1]}")
        print("    for example from", origins[0], "along", directions[0])
        print("    mj_ray", round(truth[0], 4), "with a context", dist.numpy()[0, 0])
assert seen == {"surface": (N, 0, 0)} | {name: (N, 0, N) for name in list(groups)[1:]}, seen
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
