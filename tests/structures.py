"""Structures to parametrise tests with: all, or, where each structure compiles a kernel, FAMILIES and the others as slow tests."""

from __future__ import annotations

from typing import Any

import pytest

from wrt.accel.structures import ACCELERATORS

STRUCTURES = sorted({cls.name for cls in ACCELERATORS.values()})
FAMILIES = ("bvh2", "bvh8", "grid", "kdtree")


def families_first(names: list[str] = STRUCTURES) -> list[Any]:
    """Return the names as test parameters; structures outside FAMILIES are marked slow."""
    return [name if name in FAMILIES else pytest.param(name, marks=pytest.mark.slow) for name in names]
