"""What mypy must accept, and know the types of; never run (pyproject.toml, tool.mypy)."""

from __future__ import annotations

from typing import assert_type

import numpy as np

import wrt
from wrt.accel.base import OneMesh
from wrt.accel.instances import Instances
from wrt.scene.shapes import box

worlds = wrt.build([box(), box()])
assert_type(worlds, Instances)
worlds.move(0, np.eye(4))
assert_type(wrt.build(box()), OneMesh)
assert_type(wrt.build((box().vertices, box().faces), "bvh2"), OneMesh)
