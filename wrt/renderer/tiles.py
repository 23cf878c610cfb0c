"""Tiles of a picture, and the samples that each tile still needs."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

Rectangle = tuple[int, int, int, int]  # x, y, width, height


class Work(NamedTuple):
    """Work for a tracer: the samples `first` to `first + n - 1` of each pixel of a rectangle."""

    rectangle: Rectangle
    first: int
    n: int

    @property
    def total(self) -> int:
        """Number of samples, summed over the pixels."""
        return self.rectangle[2] * self.rectangle[3] * self.n


def tiles(crop: tuple[int, int, int, int], step: int) -> Iterator[Rectangle]:
    """Yield the tiles that cover `crop` (x0, y0, x1, y1), row by row: squares of side `step`, cut at the right and bottom edges."""
    x0, y0, x1, y1 = crop
    for y in range(y0, y1, step):
        for x in range(x0, x1, step):
            yield x, y, min(step, x1 - x), min(step, y1 - y)


def corners(rectangle: Rectangle) -> tuple[int, int, int, int]:
    """Return x0, y0, x1, y1 of a rectangle x, y, width, height."""
    x, y, width, height = rectangle
    return x, y, x + width, y + height


def work_left(work: list[Work], samples: np.ndarray, crop: tuple[int, int, int, int]) -> list[Work]:
    """Return the part of the work that is not done yet. samples: samples that each pixel of the crop has, (H, W) int32.

    Rectangles are halved until all pixels of a part have equally many samples. This ends soon: the earlier run finished whole tiles."""
    out = []
    stack = work[::-1]
    while stack:
        (x, y, width, height), first, n = stack.pop()
        of_part = samples[y - crop[1] : y - crop[1] + height, x - crop[0] : x - crop[0] + width]
        low, high = int(of_part.min()), int(of_part.max())
        goal = first + n
        if low == high:
            if low < goal:
                out.append(Work((x, y, width, height), low, goal - low))
        elif low < goal:
            if width >= height:
                parts = [(x, y, width // 2, height), (x + width // 2, y, width - width // 2, height)]
            else:
                parts = [(x, y, width, height // 2), (x, y + height // 2, width, height - height // 2)]
            stack += [Work(part, first, n) for part in parts[::-1]]
    return out
