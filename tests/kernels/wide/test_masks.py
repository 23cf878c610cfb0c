"""No caller asks for a bit of an empty mask: the result depends on the processor. -DWRT_CHECK stops the process there (lanes.h)."""

import os
import subprocess
import sys

from tests.data import ROOT
from tests.kernel_tools import cpu_only

QUERIES = '''
import sys
import numpy as np
import warp as wp
wp.config.cpu_compiler_flags = f"{wp.config.cpu_compiler_flags} -DWRT_CHECK"
import wrt
from wrt.scene.shapes import box, icosphere

rng = np.random.default_rng(3)
mesh, cube = icosphere(3), box((1.0, -0.5, -0.5), (2.0, 0.5, 0.5))
moved = np.eye(4)
moved[:3, 3] = 0.3, 0.2, 0.1
moved[0, 0] = 1e-30  # a direction that must be lengthened
scene = wrt.Scene((wrt.Object(mesh), wrt.Object(cube), wrt.Object(cube, transform=moved)))
n = 203  # the last packet is not full
spread = np.concatenate([rng.normal(size=(n, 3)), [0, 0, 1] + 0.01 * rng.normal(size=(n, 3)), np.eye(3), -np.eye(3)])
origins = np.concatenate([rng.uniform(-2, 2, (n, 3)), [0, 0, -4] + 0.01 * rng.normal(size=(n, 3)), np.zeros((6, 3))])
for accel, world in ((wrt.build(mesh), None), (wrt.build(scene, movable=True), None),
                     (wrt.build([mesh, scene, cube]), rng.integers(0, 3, len(origins)))):
    for t_max in (np.inf, rng.choice([-1.0, 0.5, 3.0], len(origins))):
        found = accel.closest_hit(origins, spread, t_max=t_max, world=world).hit
        assert (accel.any_hit(origins, spread, t_max=t_max, world=world) == found).all()
        assert (wrt.count_hits(accel, origins, spread, t_max=t_max, world=world) <= len(wrt.all_hits(
            accel, origins, spread, t_max=t_max, world=world).t)).all()
        print(found.sum(), "hits")
'''


@cpu_only
def test_no_empty_mask_is_asked_for_a_bit():
    ran = subprocess.run([sys.executable, "-c", QUERIES], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0 and ran.stdout.count("hits") == 6, ran.stderr


@cpu_only
def test_an_empty_mask_is_noticed(tmp_path):
    code = QUERIES.split("import wrt\n")[0] + """
from wrt.kernels.structs import kernel
from wrt.kernels.wide.lanes import lowest

@kernel
def ask(masks: wp.array(dtype=wp.int32)):
    masks[0] = lowest(masks[0])

wp.launch(ask, dim=1, inputs=[wp.array([int(sys.argv[1])], dtype=wp.int32, device="cpu")], device="cpu")
"""
    path = tmp_path / "ask.py"
    path.write_text(code)
    assert [subprocess.run([sys.executable, path, mask], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True,
                           check=False).returncode != 0 for mask in ("4", "0")] == [False, True]
