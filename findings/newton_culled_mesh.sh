#!/usr/bin/env bash
# Library:  newton 1.8.0 (warp-lang 1.19.0, NumPy 2.4.6).
# Expected: SensorCamera.RenderConfig has enable_backface_culling=True as its default: the backs of triangles are not seen. So what is behind a
#           back is seen, as with the culling of rasterisers and of ray tracers (OptiX: "OPTIX_RAY_FLAG_CULL_BACK_FACING_TRIANGLES").
# Seen:     within one mesh the back hides all behind it. A mesh of two squares, the nearer with its back to the camera, gives 0 of 64 pixels.
#           As two meshes the same squares give 64 of 64 pixels, at the right depth; without culling, one mesh has 64 at the nearer square.
#           The mesh query finds the closest triangle first; then its side decides whether the whole mesh is hit.
# Matters:  an open mesh (a room seen through its outer wall, a cut terrain, a shell of a robot) is a hole in depth images, and the hole
#           depends on how triangles are grouped into meshes. Joining meshes to save memory changes pictures.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check newton==1.8.0 warp-lang==1.19.0 numpy==2.4.6
export WARP_CACHE_PATH="$folder/cache"
cat > "$folder/seen.py" <<'PYTHON'
import newton
import numpy as np
import warp as wp

wp.config.quiet = True
corners = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], np.float32)
near, far = corners - [0, 0, 2], corners - [0, 0, 5]  # the camera is at 0 and looks along -z
front, back = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 2, 1], [0, 3, 2]])
one = [(np.concatenate([near, far]), np.concatenate([back, front + 4]))]
two = [(near, back), (far, front)]


def picture(meshes, culling):
    """Return the number of pixels of 64 that see something, and the depths that they see."""
    builder = newton.ModelBuilder()
    for vertices, faces in meshes:
        builder.add_shape_mesh(-1, mesh=newton.Mesh(vertices, faces.reshape(-1), compute_inertia=False))
    model = builder.finalize(device="cpu")
    camera, depth = newton.sensors.SensorCamera(model), wp.zeros((1, 8, 8), dtype=wp.float32, device="cpu")
    pose = wp.array([wp.transform_identity()], dtype=wp.transformf, device="cpu")
    camera.update(model.state(), pose, camera.compute_camera_rays_pinhole(8, 8, camera_fov=0.6), forward_depth_image=depth,
                  render_config=camera.RenderConfig(enable_backface_culling=culling))
    seen = depth.numpy()[depth.numpy() > 0.0]
    return len(seen), sorted(set(np.round(seen, 3).tolist()))


assert newton.sensors.SensorCamera.RenderConfig().enable_backface_culling
result = {f"{name}, culling {culling}": picture(meshes, culling) for name, meshes in (("one mesh", one), ("two meshes", two)) for culling in (True, False)}
for name, (count, depths) in result.items():
    print(f"{name}: {count} of 64 pixels, depths {depths}")
assert result == {"one mesh, culling True": (0, []), "one mesh, culling False": (64, [2.0]),
                  "two meshes, culling True": (64, [5.0]), "two meshes, culling False": (64, [2.0])}, result
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
