"""Random defects of closed meshes in every format leave the solid as it is. `python -m tests.random_defects` checks ten thousand."""

from __future__ import annotations

import pytest

from tests.random_defects import FORMATS, check


@pytest.mark.parametrize("group", range(len(FORMATS)), ids=FORMATS)
@pytest.mark.parametrize("seed", range(4))
def test_meshes_with_defects_keep_their_inside_and_lose_no_ray(group: int, seed: int) -> None:
    assert check(group, seed) == ""
