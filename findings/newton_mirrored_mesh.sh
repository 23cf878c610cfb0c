#!/usr/bin/env bash
# Library:  newton 1.8.0 (warp-lang 1.19.0) beside mujoco 4.0.0 (NumPy 2.4.6): one MJCF text, two readers.
# Expected: a mesh with scale="-1 1 1" is mirrored and stays a solid with an outside. MuJoCo's XML reference allows negative scales, and its
#           compiler turns the faces round. Newton's docstring of intersect_ray names out_normal "hit normals".
# Seen:     MuJoCo's mesh has volume +6, and a ray from outside meets a normal against its direction. Newton's importer mirrors the vertices
#           and keeps the order of the corners: the volume is -6, and the normal of every hit points into the solid. Distances agree.
#           With two mirrored axes both agree again, with three not.
# Matters:  left and right parts of a robot are often one mesh, mirrored. Normals of hits, and tests of inside and outside by
#           these normals, are wrong for one side of the robot only. Neither reader warns.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 mujoco==4.0.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
cat > "$folder/seen.py" <<'PYTHON'
import mujoco
import newton
import numpy as np
import warp as wp

CORNERS = "-.5 -1 -1.5  .5 -1 -1.5  -.5 1 -1.5  .5 1 -1.5  -.5 -1 1.5  .5 -1 1.5  -.5 1 1.5  .5 1 1.5"
FACES = "0 2 1  1 2 3  4 5 6  5 7 6  0 1 4  1 5 4  2 6 3  3 6 7  0 4 2  2 4 6  1 3 5  3 7 5"
ORIGIN, DIRECTION = [-5.0, 0.1, 0.2], [1.0, 0.0, 0.0]


def volume(vertices, faces):
    corners = np.asarray(vertices, float)[np.asarray(faces).reshape(-1, 3)]
    return np.linalg.det(corners).sum() / 6


def with_mujoco(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    normal = np.zeros(3)
    t = mujoco.mj_ray(model, data, np.array(ORIGIN), np.array(DIRECTION), None, 1, -1, np.zeros(1, np.int32), normal)
    return volume(model.mesh_vert, model.mesh_face), t, normal[0]


def with_newton(xml):
    builder = newton.ModelBuilder()
    builder.add_mjcf(xml)
    model = builder.finalize(device="cpu")
    (mesh,) = [source for source in model.shape_source if source is not None]
    t, normal = wp.zeros(1, dtype=float, device="cpu"), wp.zeros(1, dtype=wp.vec3, device="cpu")
    newton.intersect_ray(model, ray_origins=wp.array([ORIGIN], dtype=wp.vec3, device="cpu"),
                         ray_directions=wp.array([DIRECTION], dtype=wp.vec3, device="cpu"),
                         ray_worlds=wp.array([-1], dtype=int, device="cpu"), out_dist=t, out_normal=normal)
    return volume(mesh.vertices * model.shape_scale.numpy()[0], mesh.indices), t.numpy()[0], normal.numpy()[0, 0]


print("scale, then volume, t and x of the normal: MuJoCo, Newton")
for scale, side in ("1 1 1", 1), ("-1 1 1", -1), ("-1 -1 1", 1), ("-1 -1 -1", -1):
    xml = f"""<mujoco><asset><mesh name="box" vertex="{CORNERS}" face="{FACES}" scale="{scale}"/></asset>
    <worldbody><geom type="mesh" mesh="box"/></worldbody></mujoco>"""
    theirs, other = with_mujoco(xml), with_newton(xml)
    print(f"{scale:9}", np.round(theirs, 4), np.round(other, 4))
    assert np.abs(np.subtract(theirs, [6, 4.5, -1])).max() < 1e-4
    assert np.abs(np.subtract(other, [6 * side, 4.5, -side])).max() < 1e-4
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
