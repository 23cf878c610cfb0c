"""Which structures a test takes: all, or, where each costs a kernel of its own, one of each family now and the rest when asked."""

from __future__ import annotations

from typing import Any

import pytest

from wrt.accel.structures import ACCELERATORS

STRUCTURES = sorted({cls.name for cls in ACCELERATORS.values()})
FAMILIES = ("bvh2", "bvh8", "grid", "kdtree")


def families_first(names: list[str] = STRUCTURES) -> list[Any]:
    """Test parameters; structures outside FAMILIES are marked slow."""
    return [name if name in FAMILIES else pytest.param(name, marks=pytest.mark.slow) for name in names]
