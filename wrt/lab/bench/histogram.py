"""Histograms side by side, drawn with Pillow: how many rays cost how much."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from wrt.lab.bench.plot import COLORS, GRID, INK, PALE
from wrt.picture.heatmap import font, short

PANEL = (400, 250)
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 30, 34
BINS = 60


def histograms(panels: Mapping[str, Mapping[str, np.ndarray]], title: str) -> np.ndarray:
    """(H, W, 3) uint8: a panel for each counter, and in it a line for each kind of ray. Across: what a ray costs, from 0 to
    where 99.9% of all rays are; upwards: the share of the kind's rays, logarithmic. Values of 0 or more."""
    from PIL import Image, ImageDraw

    columns = 2
    rows = math.ceil(len(panels) / columns)
    image = Image.new("RGB", (columns * PANEL[0] + 20, rows * PANEL[1] + 60), "white")
    canvas = ImageDraw.Draw(image)
    canvas.text((14, 10), title, fill=INK, font=font(15))
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    colors = dict(zip(names, COLORS * 100, strict=False))
    x = 14.0
    for name in names:
        canvas.line((x, 44, x + 18, 44), fill=colors[name], width=3)
        canvas.text((x + 24, 44), name, fill=INK, font=font(12), anchor="lm")
        x += 44 + canvas.textlength(name, font=font(12))
    for i, (counter, kinds) in enumerate(panels.items()):
        _panel(canvas, (i % columns * PANEL[0] + 10, i // columns * PANEL[1] + 56), counter, kinds, colors)
    return np.asarray(image)


def bins(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Edges of the bins, (4 k + 1,): whole numbers apart, up to where nearly all values are."""
    top = max((float(np.percentile(each, 99.9)) for each in values.values() if len(each)), default=1.0)
    width = max(1, math.ceil((top + 1.0) / BINS))
    return np.arange(0, 4 * math.ceil((top + 1.0) / (4 * width)) + 1) * width


def _panel(canvas: Any, corner: tuple[int, int], counter: str, kinds: Mapping[str, np.ndarray], colors: Mapping[str, Any]) -> None:
    x0, y0, x1, y1 = corner[0] + LEFT, corner[1] + TOP, corner[0] + PANEL[0] - RIGHT, corner[1] + PANEL[1] - BOTTOM
    edges = bins(kinds)
    shares = {name: np.histogram(values, edges)[0] / len(values) for name, values in kinds.items() if len(values)}
    least = min((share[share > 0.0].min() for share in shares.values() if share.any()), default=0.1)
    decades = max(1, math.ceil(-math.log10(least)))
    canvas.text((x0, corner[1] + 8), counter, fill=INK, font=font(13))
    for decade in range(decades + 1):
        y = y0 + (y1 - y0) * decade / decades
        canvas.line((x0, y, x1, y), fill=GRID)
        canvas.text((x0 - 6, y), f"{10.0**-decade:.0%}" if decade < 3 else f"1e-{decade}", fill=PALE, font=font(11), anchor="rm")
    for i in range(5):
        value = edges[-1] * i / 4
        canvas.text((x0 + (x1 - x0) * i / 4, y1 + 5), short(value), fill=PALE, font=font(11), anchor="mt")
    for name, share in shares.items():
        heights = np.where(share > 0.0, -np.log10(np.maximum(share, 1e-300)), decades + 1.0)
        points = []
        for left, right, down in zip(edges, edges[1:], heights, strict=False):
            y = min(y0 + (y1 - y0) * down / decades, y1)
            points += [(x0 + (x1 - x0) * left / edges[-1], y), (x0 + (x1 - x0) * right / edges[-1], y)]
        canvas.line(points, fill=colors[name], width=2)
    canvas.rectangle((x0, y0, x1, y1), outline=PALE)
