#!/usr/bin/env bash
# Library:  mitsuba 3.9.1 (drjit 1.5.0, NumPy 2.4.6), variant scalar_rgb.
# Expected: SurfaceInteraction3f.prim_index is "Primitive index, e.g. the triangle ID" of si.shape, and si.shape has the id from the scene.
#           load_dict merges "identical objects" (its docstring on optimize, which is on unless the caller says otherwise).
# Seen:     meshes that differ are merged, too, if they have the same material (src/shapes/merge.cpp): a small and a large box become one
#           shape of 24 triangles with an empty id. The same ray names triangle 6 of shape "b" or triangle 18 of shape "". Which of the two
#           it names depends on the colours in the scene: with another reflectance for one box the shapes stay apart.
# Matters:  tables of faces, labels and segmentation by si.shape and si.prim_index change when somebody edits a colour. t stays the same, so
#           that a comparison of depth shows nothing. load_dict(scene, optimize=False) keeps ids and numbers.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check mitsuba==3.9.1 drjit==1.5.0 numpy==2.4.6
cat > "$folder/seen.py" <<'PYTHON'
import mitsuba as mi

mi.set_variant("scalar_rgb")


def seen(colours, optimize):
    scene = {"type": "scene"}
    for name, place, size, grey in zip("ab", (0, 4), (0.5, 1), colours):
        scene[name] = {
            "type": "cube", "to_world": mi.ScalarTransform4f().translate([place, 0, 0]).scale(size),
            "material": {"type": "diffuse", "reflectance": {"type": "rgb", "value": grey}}}
    scene = mi.load_dict(scene, **optimize)
    hit = scene.ray_intersect(mi.Ray3f([4.2, 0.3, 5], [0, 0, -1]))
    return len(scene.shapes()), hit.shape.id(), hit.shape.face_count(), int(hit.prim_index), float(hit.t)


same, other = (0.5, 0.5), (0.5, 0.6)
for title, colours, optimize, expected in (
        ("one colour", same, {}, (1, "", 24, 18, 4.0)),
        ("two colours", other, {}, (2, "b", 12, 6, 4.0)),
        ("one colour, optimize=False", same, {"optimize": False}, (2, "b", 12, 6, 4.0))):
    values = seen(colours, optimize)
    print(f"{title}: shapes, id, faces, prim_index, t = {values}")
    assert values == expected
PYTHON
"$folder/venv/bin/python" "$folder/seen.py"
